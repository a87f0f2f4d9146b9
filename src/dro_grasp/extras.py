"""Packages that only some commands need: the extras of the installation."""

from __future__ import annotations

from importlib.util import find_spec

from dro_grasp.errors import OptionError

EXTRAS = {
    "apps": ("viser", "fastapi", "uvicorn", "cachetools"), "arm": ("mink", "daqp", "ompl", "toppra"), "ray": ("ray",),
    "gpu": ("warp", "mujoco_warp"), "tensorboard": ("tensorboard",), "usd": ("pxr",),
}
"""What an extra installs: pages in the browser and the grasp server; kinematics, its solver, motion planning and timing;
workers on clusters; simulation on a GPU; curves of training; USD stages."""


def require_extra(name: str) -> None:
    """Refuse to go on without an extra.

    Raises:
        OptionError: A package of it is missing.
    """
    if missing := [package for package in EXTRAS[name] if find_spec(package) is None]:
        raise OptionError(f"this needs packages that are not installed: {', '.join(missing)}; run "
                          f"pip install 'dro-grasp[{name}]', or pip install '.[{name}]' in the folder of the clone")
