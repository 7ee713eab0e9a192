"""``python -m lexsplat``: the command line, where the folder of scripts is not on the path."""

import sys

from lexsplat.cli import main

sys.exit(main())
