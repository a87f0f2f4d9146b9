"""The public names: type checkers read them here, and the package loads each from its module on first use."""

from dro_grasp._version import __version__ as __version__
from dro_grasp.baselines.controls import palm_facing_starts as palm_facing_starts
from dro_grasp.baselines.method import Method as Method
from dro_grasp.baselines.registry import MethodOptions as MethodOptions, make_method as make_method
from dro_grasp.datasets.bundle.training_file import load_bundle as load_bundle
from dro_grasp.datasets.collections.bundling import make_bundle as make_bundle
from dro_grasp.datasets.collections.collection import read_collection as read_collection
from dro_grasp.datasets.engine.schedule import synthesize_dataset as synthesize_dataset
from dro_grasp.datasets.engine.worker import EngineConfig as EngineConfig
from dro_grasp.errors import DroGraspError as DroGraspError
from dro_grasp.evaluation.metrics import wilson_interval as wilson_interval
from dro_grasp.export.contents import Frame as Frame
from dro_grasp.export.csv_table import csv_table as csv_table
from dro_grasp.export.dexgraspbench import dexgraspbench as dexgraspbench
from dro_grasp.export.isaac_grasp import isaac_grasp as isaac_grasp
from dro_grasp.export.moveit import moveit_grasps as moveit_grasps
from dro_grasp.grasps.batch import GraspBatch as GraspBatch
from dro_grasp.grasps.reading import load_grasps as load_grasps
from dro_grasp.hands.check import HandReport as HandReport, check_hand as check_hand
from dro_grasp.hands.hand import Hand as Hand
from dro_grasp.hands.library import hand_names as hand_names, load_hand as load_hand
from dro_grasp.hands.procedural.making import MadeHand as MadeHand, make_hand as make_hand
from dro_grasp.hands.variants import vary_hand as vary_hand
from dro_grasp.models.checkpoints import load_weights as load_weights, save_weights as save_weights
from dro_grasp.models.presets import NetworkConfig as NetworkConfig
from dro_grasp.objects.catalogue import load_object as load_object, object_names as object_names
from dro_grasp.objects.scenery import Scene as Scene, load_scene as load_scene
from dro_grasp.objects.shape import ObjectModel as ObjectModel
from dro_grasp.optimization.finger_closing import ClosingConfig as ClosingConfig
from dro_grasp.optimization.grip import GripConfig as GripConfig
from dro_grasp.optimization.refinement import RefineConfig as RefineConfig
from dro_grasp.optimization.synthesis import SynthesisConfig as SynthesisConfig, synthesize as synthesize
from dro_grasp.perception.partial_views import DepthCamera as DepthCamera, visible_points as visible_points
from dro_grasp.perception.scan import depth_points as depth_points, scanned_object as scanned_object
from dro_grasp.pipeline.choice import ChoiceConfig as ChoiceConfig, ChoicePenalties as ChoicePenalties
from dro_grasp.pipeline.constraints import Constraints as Constraints
from dro_grasp.pipeline.problem import GraspProblem as GraspProblem
from dro_grasp.pipeline.stages import complete as complete, evaluate as evaluate, rank as rank, refine as refine
from dro_grasp.planning.attempts import Attempt as Attempt, TabletopConfig as TabletopConfig
from dro_grasp.planning.motion import (
    MotionPlan as MotionPlan,
    trajectory_csv as trajectory_csv,
    trajectory_yaml as trajectory_yaml,
)
from dro_grasp.planning.planner import PlanConfig as PlanConfig, plan as plan
from dro_grasp.planning.reachability import ReachConfig as ReachConfig
from dro_grasp.planning.robot import Robot as Robot, load_robot as load_robot
from dro_grasp.planning.robot_check import RobotReport as RobotReport, check_robot as check_robot
from dro_grasp.planning.table_scene import PickedObject as PickedObject, pick_object as pick_object
from dro_grasp.planning.tabletop import TabletopRun as TabletopRun, run_tabletop as run_tabletop
from dro_grasp.predictor import (
    GraspPredictor as GraspPredictor,
    GraspRequest as GraspRequest,
    Prediction as Prediction,
    PredictorConfig as PredictorConfig,
)
from dro_grasp.serve.client import GraspClient as GraspClient
from dro_grasp.simulation.contact_quality import ContactQuality as ContactQuality, measure_contacts as measure_contacts
from dro_grasp.simulation.outcome import Failure as Failure, TrialResult as TrialResult
from dro_grasp.simulation.protocols import Perturbations as Perturbations, Protocol as Protocol
from dro_grasp.simulation.trial import simulate as simulate
from dro_grasp.training.config import (
    AugmentationConfig as AugmentationConfig,
    LossConfig as LossConfig,
    MotionConfig as MotionConfig,
    PretrainConfig as PretrainConfig,
    ScheduleConfig as ScheduleConfig,
    TrainConfig as TrainConfig,
)
from dro_grasp.training.loop import train as train
from dro_grasp.training.pretraining import pretrain as pretrain, pretrain_motion as pretrain_motion
from dro_grasp.viewer.app import view_grasps as view_grasps
from dro_grasp.viewer.pictures import PictureStyle as PictureStyle, draw_grasps as draw_grasps
