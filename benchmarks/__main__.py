"""`python -m benchmarks NAME [part ...]`."""

import sys

from benchmarks.common.command import main

if __name__ == "__main__":
    main(sys.argv[1:])
