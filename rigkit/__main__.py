"""Run the program `rigkit` by `python -m rigkit`."""

import sys

from rigkit.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
