"""D(R,O) Grasp: any robot hand description in, simulation-checked dexterous grasps out.

Public names are loaded on first use, so that importing the package costs nothing and training needs no simulator.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dro_grasp.datasets.collections.collection import read_collection
    from dro_grasp.datasets.engine.schedule import synthesize_dataset
    from dro_grasp.errors import DroGraspError
    from dro_grasp.grasps.batch import GraspBatch
    from dro_grasp.hands.hand import Hand
    from dro_grasp.hands.library import load_hand
    from dro_grasp.objects.catalogue import load_object
    from dro_grasp.objects.shape import ObjectModel
    from dro_grasp.optimization.synthesis import synthesize
    from dro_grasp.perception.scan import depth_points, scanned_object
    from dro_grasp.predictor import GraspPredictor
    from dro_grasp.simulation.trial import TrialResult, simulate

from dro_grasp._version import __version__

_EXPORTS = {
    "DroGraspError": "errors",
    "GraspBatch": "grasps.batch",
    "GraspPredictor": "predictor",
    "Hand": "hands.hand",
    "ObjectModel": "objects.shape",
    "TrialResult": "simulation.trial",
    "depth_points": "perception.scan",
    "load_hand": "hands.library",
    "load_object": "objects.catalogue",
    "read_collection": "datasets.collections.collection",
    "scanned_object": "perception.scan",
    "simulate": "simulation.trial",
    "synthesize": "optimization.synthesis",
    "synthesize_dataset": "datasets.engine.schedule",
}

__all__ = [
    "DroGraspError",
    "GraspBatch",
    "GraspPredictor",
    "Hand",
    "ObjectModel",
    "TrialResult",
    "__version__",
    "depth_points",
    "load_hand",
    "load_object",
    "read_collection",
    "scanned_object",
    "simulate",
    "synthesize",
    "synthesize_dataset",
]


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module 'dro_grasp' has no attribute '{name}'")
    return getattr(import_module(f"dro_grasp.{_EXPORTS[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
