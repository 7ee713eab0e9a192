"""``python -m lexsplat.cli``."""

import sys

from lexsplat.cli import main

if __name__ == "__main__":
    sys.exit(main())
