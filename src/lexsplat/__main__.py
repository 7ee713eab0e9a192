"""``lexsplat`` and ``python -m lexsplat``: the command line, with a clean end on Ctrl-C from the first import."""

from __future__ import annotations

import sys

from lexsplat.runtime.errors import STOPPED


def main() -> int:
    """Run one command; returns the exit status."""
    try:
        from lexsplat import cli

        return cli.main()
    except KeyboardInterrupt:
        print(STOPPED, file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
