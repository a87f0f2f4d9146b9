"""`python -m dro_grasp`: the command, where it has no script on the path."""

from __future__ import annotations

import sys

from dro_grasp.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
