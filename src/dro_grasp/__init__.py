"""D(R,O) Grasp: any robot hand description in, simulation-checked dexterous grasps out.

Public names are loaded on first use, so that importing the package costs nothing and training needs no simulator.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_EXPORTS = {
    "DroGraspError": "errors",
    "GraspBatch": "grasps.batch",
    "GraspPredictor": "predictor",
    "Hand": "hands.hand",
    "ObjectModel": "objects.shape",
    "TrialResult": "simulation.trial",
    "load_hand": "hands.library",
    "load_object": "objects.library",
    "simulate": "simulation.trial",
    "synthesize": "grasps.synthesis",
}

__all__ = ["__version__", *_EXPORTS]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module 'dro_grasp' has no attribute '{name}'")
    return getattr(import_module(f"dro_grasp.{_EXPORTS[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
