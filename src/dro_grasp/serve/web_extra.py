"""The packages of the extra `[serve]`, which only the grasp server needs."""

from __future__ import annotations

from importlib.util import find_spec

from dro_grasp.errors import OptionError

PACKAGES = ("fastapi", "uvicorn")
"""What the extra installs: pages with typed content, and the server that speaks HTTP."""


def require_serve_extra() -> None:
    """Refuse to serve without the extra.

    Raises:
        OptionError: A package is missing.
    """
    if missing := [name for name in PACKAGES if find_spec(name) is None]:
        raise OptionError(f"serving needs packages that are not installed: {', '.join(missing)}; run "
                          "pip install '.[serve]' in the folder of the clone")
