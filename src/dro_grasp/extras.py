"""Packages that only some commands need: the extras of the installation."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

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


@contextmanager
def later(package: str, module: str) -> Iterator[None]:
    """While another library is imported, let it find a package and a module of it that load themselves when first used."""
    names = package, f"{package}.{module}"
    if any(name in sys.modules for name in names):
        yield
        return
    stands: list[ModuleType] = [ModuleType(name) for name in names]
    for name, stand in zip(names, stands, strict=True):
        stand.__dict__["__getattr__"] = lambda attribute, name=name: getattr(import_module(name), attribute)
        sys.modules[name] = stand
    stands[0].__dict__[module] = stands[1]
    try:
        yield
    finally:
        for name, stand in zip(names, stands, strict=True):
            if sys.modules.get(name) is stand:
                del sys.modules[name]
