"""The packages of the extra `[arm]`, which only planning needs."""

from __future__ import annotations

from importlib.util import find_spec

from dro_grasp.errors import OptionError

PACKAGES = ("mink", "daqp", "ompl", "toppra")
"""What the extra installs: inverse kinematics, its solver, motion planning, timing."""


def require_arm_extra() -> None:
    """Refuse to plan without the extra.

    Raises:
        OptionError: A package is missing.
    """
    if missing := [name for name in PACKAGES if find_spec(name) is None]:
        raise OptionError(f"planning needs packages that are not installed: {', '.join(missing)}; run "
                          "pip install '.[arm]' in the folder of the clone")
