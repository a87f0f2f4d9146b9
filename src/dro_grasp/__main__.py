"""`dro-grasp` and `python -m dro_grasp`: the command, which Ctrl-C ends by one line even while it is still being imported."""

import sys

INTERRUPTED = 130  # Exit code after Ctrl-C: 128 plus the number of SIGINT, as shells have it


def run() -> int:
    """Run the command, and return its exit code."""
    try:
        from dro_grasp.cli.main import main

        return main()
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(run())
