"""The browser page of ``depthpose serve``: depth and pose by a form."""

from depthpose.web.app import Limits as Limits
from depthpose.web.app import address_and_hosts as address_and_hosts
from depthpose.web.app import make_app as make_app
from depthpose.web.app import open_socket as open_socket
from depthpose.web.app import run as run
