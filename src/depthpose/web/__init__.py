"""The browser page of ``depthpose serve``: depth and pose by a form."""

from depthpose.web.app import Limits as Limits
from depthpose.web.app import make_app as make_app
from depthpose.web.server import find_address_and_hosts as find_address_and_hosts
from depthpose.web.server import open_socket as open_socket
from depthpose.web.server import run as run
