"""`python -m rigkit`: the same as the program `rigkit`."""

import sys

from rigkit.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
