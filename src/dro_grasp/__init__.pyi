"""The public names: type checkers read them here, and the package loads each from its module on first use."""

from ._version import __version__ as __version__
from .apps.server.client import GraspClient as GraspClient
from .apps.viewer.grasp_page import view_grasps as view_grasps
from .arm.clearing.loop import (
    Bin as Bin,
    ClearConfig as ClearConfig,
    Cleared as Cleared,
    Rig as Rig,
    clear_table as clear_table,
)
from .arm.clearing.picks import Pick as Pick
from .arm.flat.plans import plan_or_slide as plan_or_slide
from .arm.planning.motion import MotionPlan as MotionPlan, trajectory_csv as trajectory_csv, trajectory_yaml as trajectory_yaml
from .arm.planning.planner import plan as plan
from .arm.planning.reachability import ReachConfig as ReachConfig
from .arm.planning.task import PlanConfig as PlanConfig
from .arm.planning.task_stages import task_stages as task_stages, task_yaml as task_yaml
from .arm.robot_check import RobotReport as RobotReport, check_robot as check_robot
from .arm.robots.loading import load_robot as load_robot
from .arm.robots.robot import Robot as Robot
from .arm.tabletop.attempts import Attempt as Attempt
from .arm.tabletop.experiment import TabletopConfig as TabletopConfig
from .arm.tabletop.run import TabletopRun as TabletopRun, run_tabletop as run_tabletop
from .arm.tabletop.table_scene import PickedObject as PickedObject, pick_object as pick_object
from .compare.methods import Method as Method, MethodOptions as MethodOptions, make_method as make_method
from .compare.metrics import wilson_interval as wilson_interval
from .errors import DroGraspError as DroGraspError
from .grasps.batch import GraspBatch as GraspBatch, load_grasps as load_grasps
from .grasps.export.writers import (
    Frame as Frame,
    csv_table as csv_table,
    dexgraspbench as dexgraspbench,
    isaac_grasp as isaac_grasp,
    moveit_grasps as moveit_grasps,
)
from .grasps.hold import (
    HoldCheck as HoldCheck,
    HoldConfig as HoldConfig,
    HoldExpectation as HoldExpectation,
    check_hold as check_hold,
)
from .hands.check import HandReport as HandReport, check_hand as check_hand
from .hands.hand import Hand as Hand
from .hands.library import hand_names as hand_names, load_hand as load_hand
from .hands.variants import vary_hand as vary_hand
from .network.checkpoints import load_weights as load_weights, save_weights as save_weights
from .network.presets import NetworkConfig as NetworkConfig
from .objects.catalogue import load_object as load_object, object_names as object_names
from .objects.perception.partial_views import DepthCamera as DepthCamera, visible_points as visible_points
from .objects.perception.scan import depth_points as depth_points, scanned_object as scanned_object
from .objects.perception.scene_files import SceneCamera as SceneCamera
from .objects.scenery import FoundObject as FoundObject, Scene as Scene, load_scene as load_scene
from .objects.shape import ObjectModel as ObjectModel
from .optimize.fingers import ClosingConfig as ClosingConfig
from .optimize.refinement import RefineConfig as RefineConfig
from .optimize.squeeze import GripConfig as GripConfig
from .optimize.synthesis import SynthesisConfig as SynthesisConfig, synthesize as synthesize
from .pictures.scene import draw_scene as draw_scene
from .pictures.sheets import PictureStyle as PictureStyle, draw_grasps as draw_grasps
from .predict.config import (
    GraspRequest as GraspRequest,
    PredictorConfig as PredictorConfig,
    RescueConfig as RescueConfig,
    RetryConfig as RetryConfig,
)
from .predict.constraints import Constraints as Constraints
from .predict.finish import FinishConfig as FinishConfig, Finished as Finished, finish as finish
from .predict.predictor import GraspPredictor as GraspPredictor, Prediction as Prediction
from .predict.problem import GraspProblem as GraspProblem
from .predict.settling import SettleConfig as SettleConfig
from .predict.sources.choice import ChoiceConfig as ChoiceConfig, ChoicePenalties as ChoicePenalties
from .predict.sources.controls import palm_facing_starts as palm_facing_starts
from .predict.sources.network import ProposalConfig as ProposalConfig
from .predict.sources.optimiser import OptimiserConfig as OptimiserConfig
from .predict.sources.registry import make_source as make_source, register_source as register_source
from .predict.sources.source import Candidates as Candidates, Source as Source
from .predict.sources.variation import VariationConfig as VariationConfig
from .predict.stages import complete as complete, evaluate as evaluate, rank as rank, refine as refine
from .simulation.contacts import ContactQuality as ContactQuality, measure_contacts as measure_contacts
from .simulation.forces import GraspForces as GraspForces, find_forces as find_forces
from .simulation.holding import expect_hold as expect_hold
from .simulation.outcome import Failure as Failure, TrialResult as TrialResult
from .simulation.protocols import Perturbations as Perturbations, Protocol as Protocol, protocol as protocol
from .simulation.trial import simulate as simulate
from .training.config import (
    AugmentationConfig as AugmentationConfig,
    LossConfig as LossConfig,
    MotionConfig as MotionConfig,
    PretrainConfig as PretrainConfig,
    ScheduleConfig as ScheduleConfig,
    TrainConfig as TrainConfig,
)
from .training.data.bundle.training_file import load_bundle as load_bundle
from .training.data.collections.bundling import make_bundle as make_bundle
from .training.data.collections.collection import read_collection as read_collection
from .training.data.engine.schedule import synthesize_dataset as synthesize_dataset
from .training.data.engine.worker import EngineConfig as EngineConfig
from .training.loop import train as train
from .training.made_hands.making import MadeHand as MadeHand, make_hand as make_hand
from .training.pretraining import pretrain as pretrain, pretrain_motion as pretrain_motion
