"""`dro-grasp` and `python -m dro_grasp`: the command, which Ctrl-C ends by one line even while it is still being imported."""

from __future__ import annotations

import sys


def run() -> int:
    """Run the command, and return its exit code."""
    try:
        from dro_grasp.cli.main import main

        return main()
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(run())
