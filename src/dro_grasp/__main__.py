"""`dro-grasp` and `python -m dro_grasp`: the command, which Ctrl-C ends by one line even while it is still being imported."""

from __future__ import annotations

import signal
import sys


def run() -> int:
    """Run the command, and return its exit code."""
    try:
        from dro_grasp.cli.main import main

        code = main()
        # All is written: while Python ends, Ctrl-C would kill it as if it were not.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        return code
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        print("stopped", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(run())
