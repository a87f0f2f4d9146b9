"""Tables that are cleared in MuJoCo: what the camera and the joints say, what the robot makes of it, and what is true."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from dro_grasp.arm.clearing.loop import ClearConfig, Cleared, Pick, clear_table
from dro_grasp.arm.planning.motion import Trajectory
from dro_grasp.arm.planning.physics import FRICTION, LiftScene, check_friction
from dro_grasp.arm.planning.workcell import Workcell
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.arm.tabletop.camera_view import depth_image
from dro_grasp.arm.tabletop.experiment import TabletopConfig, Watcher
from dro_grasp.arm.tabletop.table_setup import Region, scatter
from dro_grasp.errors import ObjectError, OptionError, PlanError
from dro_grasp.grasps.hold import HoldCheck
from dro_grasp.kinds import Checked
from dro_grasp.objects.perception.depth_noise import NoiseName
from dro_grasp.objects.perception.scan import depth_points
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.predictor import GraspPredictor

LOW = 0.05  # Depth below the table from which on a thing has fallen off [m] (ours)


@dataclass(frozen=True)
class ClearTrialConfig(Checked):
    """How a table is set up and cleared. Values are ours."""

    region: Region = TabletopConfig.region
    """Area where things are put, as in `TabletopConfig`."""
    noise: float | NoiseName = TabletopConfig.noise
    """Noise of the camera's depth, likewise."""
    friction: float = FRICTION
    """Coefficient of friction between hand, things and table, likewise."""
    apart: float = 0.005
    """Distance between the outlines of things as they are put down [m]; some then come to touch."""
    clear: ClearConfig = field(default_factory=ClearConfig)
    """How it is cleared."""

    def __post_init__(self) -> None:
        """Refuse friction that is none: OptionError."""
        super().__post_init__()
        check_friction(self.friction)


@dataclass(frozen=True)
class ClearTrial:
    """What became of one table."""

    objects: tuple[str, ...]
    """Names of what stood on it."""
    removed: tuple[bool, ...]
    """Which of these ended in the bin."""
    fallen: tuple[bool, ...]
    """Which fell off the table."""
    cleared: Cleared
    """What the robot knows."""
    judgements: tuple[tuple[str, bool], ...] = ()
    """What the robot made of its joints each time that it asked, and whether the hand really held something."""
    reason: str = ""
    """Why nothing was tried, or what ended it."""


class SimulatedRig:
    """A robot and a camera in MuJoCo."""

    def __init__(self, scene: LiftScene, noise: float | NoiseName, seed: int, watch: Watcher | None = None) -> None:
        """Move the scene's robot; noise and seed are those of its camera."""
        self.scene, self._noise, self._seed, self._watch, self._looks = scene, noise, seed, watch, 0

    def look(self) -> Float[np.ndarray, "n 3"]:
        """As of `Rig`."""
        camera = self.scene.robot.camera
        assert camera is not None
        self._looks += 1
        depth, _ = depth_image(self.scene, camera, self._noise, self._seed + self._looks)
        points = depth_points(depth, camera.intrinsics)
        if self._watch is not None:
            self._watch.looked(points)
        return points

    def move(self, arm: Trajectory, hand: Trajectory) -> None:
        """As of `Rig`."""
        call = None if self._watch is None else lambda: self._watch.moved(self.scene)  # type: ignore[union-attr]
        self.scene.follow(arm, hand, slice(0, len(arm.time)), call)

    def joints(self) -> tuple[Float[np.ndarray, " n_arm"], Float[np.ndarray, " n_dof"]]:
        """As of `Rig`."""
        return self.scene.joints()

    def holds(self) -> bool:
        """Whether the hand really touches something."""
        return any(self.scene.touched(i) for i in range(len(self.scene.objects)))


def clear_trial(
    robot: Robot, objects: Sequence[ObjectModel], number: int, seed: int, predictor: GraspPredictor,
    config: ClearTrialConfig | None = None, watch: Watcher | None = None, progress: Callable[[Pick], None] | None = None,
) -> ClearTrial:
    """Put things on the table and let the robot clear it; each number draws other places.

    Raises:
        OptionError: The robot lacks a table or a camera, or a thing is a bare cloud.
    """
    config = config or ClearTrialConfig()
    if clouds := [obj.name for obj in objects if obj.is_cloud]:
        raise OptionError(f"object '{clouds[0]}' is a bare cloud; tables are simulated, and need meshes")
    robot.require_table()
    table = robot.table
    assert table is not None
    scene = LiftScene(Workcell(robot), objects, [config.clear.bin.walls(table.height)], config.friction)
    names, nothing = tuple(obj.name for obj in objects), (False,) * len(objects)
    if not scatter(scene, config.region, np.random.default_rng([seed, number]), config.apart):
        return ClearTrial(names, nothing, nothing, Cleared((), ()), reason="a thing rolls off wherever it is put")
    rig = SimulatedRig(scene, config.noise, seed + 1000 * number, watch)
    judgements = list[tuple[str, bool]]()
    picks, reason = list[Pick](), ""

    def judged(check: HoldCheck) -> None:
        judgements.append((check.state, rig.holds()))
        if watch is not None:
            watch.judged(check, judgements[-1][1])

    def picked(pick: Pick) -> None:
        picks.append(pick)
        if progress is not None:
            progress(pick)

    try:
        cleared = clear_table(robot, rig, predictor, config.clear, seed + 1000 * number, picked, judged)
    except (ObjectError, PlanError) as error:  # as on a robot, a person has to help; what is removed counts
        cleared, reason = Cleared(tuple(picks), ()), str(error)
    scene.advance(1.0)
    centres = [(T[:3, :3] @ obj.centre_of_mass + T[:3, 3])[None] for i, obj in enumerate(objects) for T in [scene.pose(i)]]
    fallen = tuple(bool(centre[0, 2] < table.height - LOW) for centre in centres)
    removed = tuple(bool(config.clear.bin.holds(centre)[0]) and not fell for centre, fell in zip(centres, fallen, strict=True))
    return ClearTrial(names, removed, fallen, cleared, tuple(judgements), reason)
