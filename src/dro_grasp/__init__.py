"""D(R,O) Grasp: any robot hand description in, simulation-checked dexterous grasps out.

Public names are loaded on first use, so that importing the package costs nothing and training needs no simulator.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dro_grasp.datasets.bundle.training_file import load_bundle
    from dro_grasp.datasets.collections.bundling import make_bundle
    from dro_grasp.datasets.collections.collection import read_collection
    from dro_grasp.datasets.engine.schedule import synthesize_dataset
    from dro_grasp.datasets.engine.worker import EngineConfig
    from dro_grasp.errors import DroGraspError
    from dro_grasp.evaluation.controls import palm_facing_starts
    from dro_grasp.evaluation.metrics import wilson_interval
    from dro_grasp.export.csv_table import csv_table
    from dro_grasp.export.dexgraspbench import dexgraspbench
    from dro_grasp.export.frame import Frame
    from dro_grasp.export.isaac_grasp import isaac_grasp
    from dro_grasp.export.moveit import moveit_grasps
    from dro_grasp.grasps.batch import GraspBatch
    from dro_grasp.hands.check import HandReport, check_hand
    from dro_grasp.hands.hand import Hand
    from dro_grasp.hands.library import hand_names, load_hand
    from dro_grasp.models.checkpoints import load_weights, save_weights
    from dro_grasp.models.presets import NetworkConfig
    from dro_grasp.objects.catalogue import load_object, object_names
    from dro_grasp.objects.shape import ObjectModel
    from dro_grasp.optimization.refinement import RefineConfig
    from dro_grasp.optimization.synthesis import SynthesisConfig, synthesize
    from dro_grasp.perception.depth_camera import DepthCamera, visible_points
    from dro_grasp.perception.scan import depth_points, scanned_object
    from dro_grasp.pipeline.problem import GraspProblem
    from dro_grasp.pipeline.stages import evaluate, rank, refine
    from dro_grasp.predictor import GraspPredictor, GraspRequest, Prediction, PredictorConfig
    from dro_grasp.simulation.outcome import Failure, TrialResult
    from dro_grasp.simulation.protocols import Protocol
    from dro_grasp.simulation.trial import simulate
    from dro_grasp.training.config import (
        AugmentationConfig,
        LossConfig,
        MotionConfig,
        PretrainConfig,
        ScheduleConfig,
        TrainConfig,
    )
    from dro_grasp.training.loop import train
    from dro_grasp.training.pretraining import pretrain, pretrain_motion
    from dro_grasp.viewer.app import view_grasps
    from dro_grasp.viewer.pictures import draw_grasps

from dro_grasp._version import __version__

_EXPORTS = {
    "AugmentationConfig": "training.config",
    "DepthCamera": "perception.depth_camera",
    "DroGraspError": "errors",
    "EngineConfig": "datasets.engine.worker",
    "Failure": "simulation.outcome",
    "Frame": "export.frame",
    "GraspBatch": "grasps.batch",
    "GraspPredictor": "predictor",
    "GraspProblem": "pipeline.problem",
    "GraspRequest": "predictor",
    "Hand": "hands.hand",
    "HandReport": "hands.check",
    "LossConfig": "training.config",
    "MotionConfig": "training.config",
    "NetworkConfig": "models.presets",
    "ObjectModel": "objects.shape",
    "Prediction": "predictor",
    "PredictorConfig": "predictor",
    "PretrainConfig": "training.config",
    "Protocol": "simulation.protocols",
    "RefineConfig": "optimization.refinement",
    "ScheduleConfig": "training.config",
    "SynthesisConfig": "optimization.synthesis",
    "TrainConfig": "training.config",
    "TrialResult": "simulation.outcome",
    "check_hand": "hands.check",
    "csv_table": "export.csv_table",
    "depth_points": "perception.scan",
    "dexgraspbench": "export.dexgraspbench",
    "draw_grasps": "viewer.pictures",
    "evaluate": "pipeline.stages",
    "hand_names": "hands.library",
    "isaac_grasp": "export.isaac_grasp",
    "load_bundle": "datasets.bundle.training_file",
    "load_hand": "hands.library",
    "load_object": "objects.catalogue",
    "load_weights": "models.checkpoints",
    "make_bundle": "datasets.collections.bundling",
    "moveit_grasps": "export.moveit",
    "object_names": "objects.catalogue",
    "palm_facing_starts": "evaluation.controls",
    "pretrain": "training.pretraining",
    "pretrain_motion": "training.pretraining",
    "read_collection": "datasets.collections.collection",
    "rank": "pipeline.stages",
    "refine": "pipeline.stages",
    "save_weights": "models.checkpoints",
    "scanned_object": "perception.scan",
    "simulate": "simulation.trial",
    "synthesize": "optimization.synthesis",
    "synthesize_dataset": "datasets.engine.schedule",
    "train": "training.loop",
    "view_grasps": "viewer.app",
    "visible_points": "perception.depth_camera",
    "wilson_interval": "evaluation.metrics",
}
"""Module of each public name, below this package."""

__all__ = [
    "AugmentationConfig",
    "DepthCamera",
    "DroGraspError",
    "EngineConfig",
    "Failure",
    "Frame",
    "GraspBatch",
    "GraspPredictor",
    "GraspProblem",
    "GraspRequest",
    "Hand",
    "HandReport",
    "LossConfig",
    "MotionConfig",
    "NetworkConfig",
    "ObjectModel",
    "Prediction",
    "PredictorConfig",
    "PretrainConfig",
    "Protocol",
    "RefineConfig",
    "ScheduleConfig",
    "SynthesisConfig",
    "TrainConfig",
    "TrialResult",
    "__version__",
    "check_hand",
    "csv_table",
    "depth_points",
    "dexgraspbench",
    "draw_grasps",
    "evaluate",
    "hand_names",
    "isaac_grasp",
    "load_bundle",
    "load_hand",
    "load_object",
    "load_weights",
    "make_bundle",
    "moveit_grasps",
    "object_names",
    "palm_facing_starts",
    "pretrain",
    "pretrain_motion",
    "rank",
    "read_collection",
    "refine",
    "save_weights",
    "scanned_object",
    "simulate",
    "synthesize",
    "synthesize_dataset",
    "train",
    "view_grasps",
    "visible_points",
    "wilson_interval",
]


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module 'dro_grasp' has no attribute '{name}'")
    return getattr(import_module(f"dro_grasp.{_EXPORTS[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
