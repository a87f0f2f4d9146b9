"""Where a file comes from: the command that made it, the commit of the code, and the version."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from dro_grasp._version import __version__
from dro_grasp.files import command

PACKAGE = Path(__file__).parent  # Folder whose clone is meant


def made_by() -> dict[str, str]:
    """Command, commit and version, as weights state them; the commit is empty outside a clone, and names changes."""
    return {"command": this_command(), "commit": commit(), "version": __version__}


def this_command() -> str:
    """The command that started this process, as a user types it."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    module = "" if spec is None else spec.name.removesuffix(".__main__")
    words = ["python", "-m", module] if module else [Path(sys.argv[0]).name]
    return command(*(["dro-grasp"] if module == "dro_grasp" else words), *sys.argv[1:])


def commit() -> str:
    """The commit of the clone that the package lies in; empty without a clone.

    There is `+` behind it where the package's code is changed, or that of a script of the clone that runs now.
    """
    script = getattr(sys.modules["__main__"], "__file__", None)
    beside = [] if script is None else [Path(script).resolve().parent]
    try:
        head = _git("rev-parse", "HEAD")[:10]
        _git("ls-files", "--error-unmatch", "--", __file__)  # fails where the package was copied into a clone of something else
        root = Path(_git("rev-parse", "--show-toplevel"))
        changed = _git("status", "-s", "-uno", "--", ".", *(str(folder) for folder in beside if folder.is_relative_to(root)))
    except (OSError, subprocess.SubprocessError):
        return ""
    return head + ("+" if changed else "")


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=PACKAGE, capture_output=True, text=True, check=True, timeout=20)
    return done.stdout.strip()
