"""Entry point of the command `pigjax`: Ctrl-C is answered from the first moment, while the libraries load."""

from __future__ import annotations

import os
import signal
from types import FrameType


def main() -> None:
    """Load the package, then run `pigjax.cli.main`."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _leave)
    from pigjax.cli import main as command

    command()


def _leave(number: int, frame: FrameType | None) -> None:
    # an exception could be caught by a library that is half loaded; there is nothing to clear up yet
    os.write(2, b"stopped; run the same command again to go on from the last saved state.\n")
    os._exit(128 + number)


if __name__ == "__main__":
    main()
