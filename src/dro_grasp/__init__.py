"""D(R,O) Grasp: any robot hand description in, simulation-checked dexterous grasps out.

    import dro_grasp as dro

    hand, obj = dro.load_hand("allegro"), dro.load_object("mug")   # names, or your own files
    grasps = dro.GraspPredictor().predict(hand, obj, num=16)       # the best first
    grasps = grasps.with_trial(dro.simulate(hand, obj, grasps))    # each tested in simulation
    grasps[grasps.success].save("grasps.parquet")
    dro.draw_grasps(hand, obj, grasps, "grasps.png")

Lengths are metres, angles radians, quaternions WXYZ; `T_a_b` takes coordinates in frame b to coordinates in frame a.

Public names are loaded on first use, so that importing the package costs nothing and training needs no simulator. They are
listed once, in `__init__.pyi`, which type checkers read as well.
"""

from __future__ import annotations

import ast
import pkgutil
from importlib import import_module
from typing import Any

from dro_grasp._version import __version__ as __version__

_EXPORTS = {alias.name: str(node.module) for node in ast.parse(pkgutil.get_data(__name__, "__init__.pyi") or b"").body
            if isinstance(node, ast.ImportFrom) for alias in node.names}
"""Module of each public name."""
__all__ = list(_EXPORTS)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module 'dro_grasp' has no attribute '{name}'")
    return getattr(import_module(_EXPORTS[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
