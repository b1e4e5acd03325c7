"""``python -m depthpose`` is the ``depthpose`` command."""

import sys

from depthpose.cli import main

sys.exit(main())
