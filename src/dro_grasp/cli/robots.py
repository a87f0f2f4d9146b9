"""`dro-grasp plan`, `tabletop` and `robot`: motions of arms that carry a hand, their trial in simulation, and checks."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dro_grasp.cli.given_scene import SceneOptions, check_choice, find_on_table, seen_from
from dro_grasp.cli.inputs import ConstraintOptions, Flag, Friction, Mass, PalmOptions, load_obstacle, optional
from dro_grasp.cli.output import print_json, print_report, print_result, print_table, say, say_aside, say_doubts, say_file
from dro_grasp.errors import OptionError
from dro_grasp.extras import require_extra
from dro_grasp.files import check_output, given_path, replacing, require_distinct
from dro_grasp.kinds import require_seed

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from jaxtyping import Float

    from dro_grasp.arm.planning.motion import MotionPlan
    from dro_grasp.arm.robots.robot import Robot
    from dro_grasp.arm.tabletop.attempts import Attempt
    from dro_grasp.arm.tabletop.table_scene import PickedObject


FLOATS = 0.1
"""Height above the table from which on an object is said to float [m] (ours): of a bulge a camera sees no lower part."""


@dataclass(frozen=True)
class Plan:
    """Plan the motion with which a robot grasps an object, lifts it, and may put it down. Needs the extra `[arm]`.

    Example: dro-grasp plan --robot xarm7_leaphand --object mug --at 0.5 0.1 --output plan.npz --trajectory plan.yaml
    """

    robot: str  # A robot file, or the name of a built-in robot (see `dro-grasp robot list`).
    object: Annotated[str | None, optional("NAME|PATH", "none, with --scene")] = None
    """An object's name (see `dro-grasp objects`), a mesh, or a cloud (PLY, NPY, PCD), in the robot's world frame. A cloud may
    also show the table."""
    camera: Annotated[str | None, optional("JSON|robot", "the object is in the world frame")] = None
    """File with {"frame": "world", "T_frame_camera": 4x4}, or `robot` for the camera of the robot file. Object or scene are
    then in the camera's frame, and the unseen side is completed. For depth images, with "intrinsics": 3x3."""
    pose: Annotated[Path | None, optional("JSON", "the object's frame is the world frame")] = None
    """File with {"frame": "world", "T_frame_object": 4x4}: where the object stands."""
    at: Annotated[tuple[float, ...] | None, optional("X Y [Z]", "as --pose says, or the only thing")] = None
    """X Y: put the object on the table at this place [m], upright as in its own frame. X Y Z: which thing of the scene, the one
    at this place in the world [m]."""
    seen: SceneOptions = field(default_factory=SceneOptions)
    obstacles: tuple[str, ...] = ()  # Clouds and meshes of things, in the world frame, that nothing may touch.
    surroundings: Annotated[Path | None, optional("MESH|CLOUD", "nothing")] = None
    """Mesh or cloud of what stands around, without object and robot, of any size, in the world frame. Hand and arm stay clear
    of it."""
    start: Annotated[tuple[float, ...] | None, optional("Q ...", "the robot's home")] = None
    """Where the arm's joints are when the motion begins [rad or m], from the base on."""
    place: Annotated[tuple[float, ...] | None, optional("X Y Z [YAW]", "the object stays in the hand")] = None
    """Where to put it, and let it go: the middle of its foot [m], upright as it stands, and its turn about the vertical [rad];
    any without YAW."""
    place_on: Annotated[str | None, optional("SURFACE", "--place says where")] = None
    """Put it on a free place that is chosen: `table`, or the name of one of --obstacles."""
    no_slide: Flag = False
    """Do not push what lies flat to an edge of the table. By default a plan does that, and nothing else, where no grasp is
    trusted: look again after it, and plan again."""
    constraints: ConstraintOptions = field(default_factory=ConstraintOptions)  # In the world frame.
    mass: Mass = None  # Mass of the object [kg], which the grasp shall carry.
    num: int = 8  # Grasps that are asked for, in each of up to three batches; each is tried as soon as it is known.
    top: int = 5  # Best reachable grasps that the planner gets at once.
    rehearsals: int = 8
    """Grasps whose lift is simulated, on the object as it is known, whenever there are new ones; 0 for none."""
    friction: Friction = 0.5
    directions: Literal["paper", "all"] = "all"
    """Palm directions. paper: from above to the right side. all: every direction for which the table leaves room."""
    least_confidence: Annotated[float | None, optional("P", "0.2 with --rehearsals 0, else 0.12")] = None
    """Grasps that hold with less probability are not tried; 0 tries all. By default, the last of three batches also tries
    those that hold the object when rehearsed."""
    planner_seconds: float = 3.0  # Longest processor time for one path [s].
    seed: int = 0  # Seed of grasps, inverse kinematics and planner.
    weights: Annotated[str | None, optional("NAME|PATH", "the shipped weights")] = None
    """Name of shipped weights (see `dro-grasp weights list`) or the path of a weights file."""
    output: Annotated[Path | None, optional("NPZ", "not saved")] = None
    """Plan file: arm and hand over time, by stage, and what was dropped."""
    trajectory: Annotated[Path | None, optional("YAML", "not written")] = None
    """The motion as trajectory_msgs/JointTrajectory, one for the arm and one for the hand."""
    efforts: Flag = False
    """Write efforts into the hand's points of --trajectory, for controllers with an effort interface; others refuse them."""
    csv: Annotated[Path | None, optional("CSV", "not written")] = None  # The motion as a table.
    stages: Annotated[Path | None, optional("YAML", "not written")] = None
    """The task as stages of MoveIt Task Constructor, which plans the motions between them anew."""
    json: Flag = False  # Print one JSON object instead of text.

    def run(self, make: Callable[..., MotionPlan] | None = None) -> int:
        """Check everything that can be checked before the work, then plan, or make the plan in another way, and write."""
        from dro_grasp.arm.flat.plans import plan_or_slide
        from dro_grasp.arm.planning.placing import Place
        from dro_grasp.arm.planning.planner import plan
        from dro_grasp.arm.planning.task import PlanConfig
        from dro_grasp.arm.robots.loading import load_robot
        from dro_grasp.objects.scenery import load_scene
        from dro_grasp.objects.shape import with_mass
        from dro_grasp.predict.predictor import GraspPredictor

        require_extra("arm")
        require_seed(self.seed, 31)
        self.check_scene()
        constraints = self.constraints.constraints(
            obstacles=None if self.surroundings is None else load_scene(self.surroundings))
        config = PlanConfig(
            self.num, self.top, self.directions, constraints, rehearsals=self.rehearsals, friction=self.friction,
            planner_seconds=self.planner_seconds, least_confidence=self.least_confidence)
        for path, ending in ((self.output, ".npz"), (self.trajectory, ".yaml"), (self.csv, ".csv"), (self.stages, ".yaml")):
            if path is not None:
                check_output(path, ending)
        require_distinct(trajectory=self.trajectory, stages=self.stages)
        if self.place is not None and self.place_on is not None:
            raise OptionError("--place and --place-on both say where to put the object; give one of them")
        if self.place is not None:
            Place.of(self.place)  # refused before the work
        if self.efforts and self.trajectory is None:
            raise OptionError("--efforts are written into the trajectory file; name one with --trajectory YAML")
        robot = load_robot(self.robot)
        say_doubts(robot.hand.description)
        obstacles = [load_obstacle(name) for name in self.obstacles]
        picked, T_world_object = self._place(robot)
        robot, obj, obstacles = picked.robot, picked.obj, [*obstacles, *picked.obstacles]
        if self.mass is not None:
            obj = with_mass(obj, self.mass)
        lowest = float((obj.cloud @ T_world_object[2, :3]).min() + T_world_object[2, 3])
        if robot.table is None:
            say_aside(f"robot '{robot.name}' states no table: the plane below {obj.name}, z = {lowest:.3f} m, is taken for "
                      "one; state `table` in the robot file")
        if robot.table is not None and lowest > robot.table.height + FLOATS:
            say_aside(f"{obj.name} floats {lowest - robot.table.height:.2f} m above the table; if nothing holds it there, "
                      "say where it is (--camera, --pose, --at)")
        for note in obj.notes:
            say_aside(f"{obj.name}: {note}")
        made = (make or (plan if self.no_slide else plan_or_slide))(
            robot, obj, T_world_object, obstacles, GraspPredictor(self.weights), config, self.seed, start=self.start,
            place=self.place or self.place_on)
        written = self._write(made, robot)
        if self.json:
            print_json({**asdict(made.notes), "motion_seconds": made.seconds, **written})
            return 0
        for line in made.lines():
            say(line)
        for what, path in written.items():
            say_file(what, path)
        return 0

    def _write(self, made: MotionPlan, robot: Robot) -> dict[str, str]:
        """Write the files that were asked for; returns their paths."""
        from dro_grasp.arm.planning.motion import trajectory_csv, trajectory_yaml
        from dro_grasp.arm.planning.task_stages import task_yaml

        if self.efforts and made.notes.squeeze_torque is None:
            say_aside("warning: the efforts of the grasp are unknown, so the hand's points have none; close with a low limit")
        if self.output is not None:
            made.save(self.output)
        texts: tuple[tuple[str, Path | None, Callable[[], str]], ...] = (
            ("trajectory", self.trajectory, lambda: trajectory_yaml(made, self.efforts)),
            ("csv", self.csv, lambda: trajectory_csv(made)), ("stages", self.stages, lambda: task_yaml(made, robot)))
        for what, path, text in texts:
            if path is not None:
                with replacing(path, what) as temporary:
                    temporary.write_text(text(), encoding="utf-8")
        return {what: str(path) for what, path, *_ in (("plan", self.output), *texts) if path}

    def check_scene(self) -> None:
        """Refuse options that contradict one another, by an OptionError."""
        check_choice(self, own=("--at",))
        if self.at is not None:
            wanted, such = (("x and y", "0.5 0.1"), ("x, y and z", "0.5 0.1 0.05"))[self.seen.scene is not None]
            if len(self.at) != 2 + (self.seen.scene is not None) or not all(map(math.isfinite, self.at)):
                raise OptionError(f"--at is {' '.join(f'{value:g}' for value in self.at)}; give {wanted} in metres, such as "
                                  f"--at {such}, of {'the scene' if self.seen.scene is not None else 'the object'}")
        if self.seen.scene is not None and self.pose is not None:
            raise OptionError("--pose says where an object stands that is given alone; leave it out: a scene is in the world's "
                              "or a camera's frame")
        if self.seen.scene is None and sum(given is not None for given in (self.camera, self.pose, self.at)) > 1:
            raise OptionError("--camera, --pose and --at each say where the object is; give one of them")

    def _place(self, robot: Robot) -> tuple[PickedObject, Float[np.ndarray, "4 4"]]:
        """The object with what stands around it, and where its frame is in the world."""
        import numpy as np

        from dro_grasp.arm.robots.robot import Table
        from dro_grasp.arm.tabletop.table_scene import PickedObject, at_seen_height, seen_on_table
        from dro_grasp.frames import read_motion
        from dro_grasp.objects.catalogue import load_object
        from dro_grasp.objects.perception.scan import load_scan
        from dro_grasp.objects.scenery import load_scene

        T, camera = np.eye(4), seen_from(self.camera, robot)
        if self.seen.scene is not None:
            return find_on_table(seen_on_table(load_scene(self.seen.scene, camera=camera), robot), robot, self), T
        assert self.object is not None
        if camera is not None:
            obj = load_scan(given_path(self.object), camera.T_frame_camera)
        else:
            obj = load_object(self.object)
        if self.pose is not None:
            T = read_motion(self.pose, "T_frame_object").T.double().numpy()
        elif self.at is not None:
            if robot.table is None:
                say_aside(f"robot '{robot.name}' states no table: z = 0 is taken for one; state `table` in the robot file")
                robot = replace(robot, table=Table(0.0, (self.at[0], self.at[1])))
            assert robot.table is not None
            T[:3, 3] = *self.at, robot.table.height - float(obj.cloud[:, 2].min())
        elif obj.table is not None and robot.table is not None:  # it was cut off the cloud
            return PickedObject(obj, [], at_seen_height(robot, obj)).noted(robot), T
        return PickedObject(obj, [], robot), T


@dataclass(frozen=True)
class Tabletop:
    """Let a robot see, plan, grasp, lift, hold and shake objects on its table, or place them, in MuJoCo. Needs `[arm]`.

    Example: dro-grasp tabletop --robot xarm7_leaphand --objects mug can --attempts 2 --output results.parquet
    """

    robot: str  # A robot file, or the name of a built-in robot (see `dro-grasp robot list`).
    objects: tuple[str, ...]  # Names or files of meshes, or groups such as builtin:test.
    attempts: int = 10  # Attempts with each object, each at another place and in another pose.
    see: Literal["cloud", "mesh"] = "cloud"
    """What the planner is given: the cloud of the robot's camera, or, as a control, the true mesh at its true place."""
    order: Literal["score", "random"] = "score"  # Reachable grasps to take: the best by score, or, as a control, any.
    directions: Literal["paper", "all"] = "all"  # Palm directions: paper, from above to the right side, or all.
    constraints: PalmOptions = field(default_factory=PalmOptions)  # In the world frame.
    place: Flag = False
    """Put each object down at a random free place, 15 cm away at least, instead of holding and shaking it. It succeeds within
    2 cm and 15 degrees, upright."""
    no_slide: Flag = False  # Do not push what lies flat to an edge of the table where no grasp of it is trusted.
    mass: Mass = None  # Mass of each object to lift [kg], which its grasps shall carry.
    num: int = 8  # Grasps that are asked for, in each of up to three batches; each is tried as soon as it is known.
    rehearsals: int = 8
    """Grasps of each batch whose lift is simulated on the object as it is known, before one is chosen; 0 for none."""
    friction: Friction = 0.5
    region: Annotated[tuple[float, float, float, float] | None, optional("X0 Y0 X1 Y1", "0.38 -0.18 0.58 0.18")] = None
    """Two corners of the area where objects are put, from the arm's base [m]. A small arm needs a nearer one."""
    clutter: int = 0
    """Number of other built-in objects that stand around the one to grasp: 2 to 4 make a crowd."""
    segment: Literal["cluster", "mask"] = "cluster"
    """How the object's points are separated from others: by distance (cluster), or by the true mask, which also shows what is
    too flat for the camera's depth."""
    noise: float | Literal["none", "structured_light", "time_of_flight", "stereo"] = "stereo"
    """Noise of the camera's depth: that of a kind of camera, or a standard deviation alike for all pixels [m]."""
    seed: int = 0  # Seed of all draws.
    weights: Annotated[str | None, optional("NAME|PATH", "the shipped weights")] = None
    """Name of shipped weights (see `dro-grasp weights list`) or the path of a weights file."""
    workers: int = 1  # Processes; each takes one object after the other.
    output: Annotated[Path | None, optional("PARQUET", "not saved")] = None
    """File for a row an attempt, with stage, reason, times and seed. A rerun repeats no attempt that it holds with the same
    robot, object, weights, settings and seed."""
    plans: Annotated[Path | None, optional("FOLDER", "not saved")] = None
    """Folder for the plan of each attempt, ROBOT-OBJECT-NUMBER.npz."""
    video: Annotated[Path | None, optional("GIF|WEBP", "none")] = None
    """Animation of the first attempt, which runs once more for it."""
    json: Flag = False  # Print one JSON object instead of text.

    def run(self, make: Callable[..., Attempt] | None = None) -> int:
        """Run what is missing, or make it in another way, store and print."""
        require_extra("arm")
        from dro_grasp.arm.planning.task import PlanConfig
        from dro_grasp.arm.tabletop.animation import FORMATS, draw_attempt
        from dro_grasp.arm.tabletop.experiment import TabletopConfig
        from dro_grasp.arm.tabletop.run import TabletopRun, run_tabletop
        from dro_grasp.objects.catalogue import resolve_objects

        if self.video is not None:
            check_output(self.video, *FORMATS)
        config = TabletopConfig(
            self.see, self.noise, self.region or TabletopConfig.region, clutter=self.clutter, segment=self.segment,
            mass=self.mass, friction=self.friction, slide=not self.no_slide, place=self.place, plan=PlanConfig(
                self.num, friction=self.friction, directions=self.directions, order=self.order, rehearsals=self.rehearsals,
                constraints=self.constraints.constraints()))
        run = TabletopRun(
            self.robot, tuple(resolve_objects(list(self.objects))), self.attempts, self.seed, self.weights, config)
        made: list[Attempt] = []

        def told(attempt: Attempt) -> None:
            made.append(attempt)
            if not self.json:
                _say(attempt)

        done = run_tabletop(run, self.output, self.workers, told, self.plans, make)
        if self.plans is not None and len(done) > len(made):
            say_aside(f"{len(done) - len(made)} of {len(done)} attempts are in --output already, and --plans gets none of them")
        self._report(done)
        if self.video is not None:
            moved = next((each for each in done if each.moved), None)
            if moved is None:
                say_aside(f"warning: no robot moved in any attempt, so {self.video} is not drawn")
                return 0
            draw_attempt(run, moved, self.video)
            say_file("video", self.video, aside=True)
        return 0

    def _report(self, done: list[Attempt]) -> None:
        from dro_grasp.arm.tabletop.attempts import endings, failures, lifted, placing_errors, processor_seconds
        from dro_grasp.compare.metrics import wilson_interval

        held = sum(a.success for a in done)
        low, high = wilson_interval(held, len(done))
        seconds = processor_seconds(done)
        raised, errors = len(lifted(done)), placing_errors(done)
        if self.json:
            placing = {"lifted": raised, "placing_errors": errors} if self.place else {}
            print_json({
                "robot": done[0].robot, "attempts": len(done), "success": held, "success_rate": held / len(done),
                "interval": [low, high], **placing, "ended": endings(done), "processor_seconds": seconds,
                "failures": failures(done)})
            return
        rows = []
        for name in dict.fromkeys(a.object for a in done):
            own = [a for a in done if a.object == name]
            ended = ", ".join(f"{stage} {count}" for stage, count in endings(own).items())
            rows.append([name, f"{sum(a.success for a in own)} of {len(own)}", ended])
        print_table(f"{done[0].robot}: lifts", ["object", "placed" if self.place else "held", "ended in"], rows)
        say(f"{held} of {len(done)} attempts succeeded ({held / len(done):.0%}, 95 % interval {low:.0%} to {high:.0%})")
        if self.place and raised:
            low, high = wilson_interval(held, raised)
            told = f"; median {1e3 * errors['error']:.0f} mm and {errors['tilt']:.0f} degrees off" if errors else ""
            say(f"{held} of {raised} that were lifted are placed ({held / raised:.0%}, 95 % interval {low:.0%} to {high:.0%})"
                + told)
        if seconds:
            say(f"depth image to timed plan, time of one core: median {seconds['median']:.1f} s, 95 % within "
                f"{seconds['within_95']:.1f} s (n = {seconds['n']})")
        if self.output is not None:
            say_file("attempts", self.output)


def _say(attempt: Attempt) -> None:
    done = "held" if attempt.place_error is None else "placed"
    outcome = done if attempt.success else f"{attempt.stage}: {attempt.reason}"
    say_aside(f"{attempt.object}, attempt {attempt.number}: {outcome}")


@dataclass(frozen=True)
class CheckRobot:
    """Check a robot description: its chains, limits, reach and collisions; and draw it.

    Example: dro-grasp robot check robot.yaml --picture robot.png
    """

    robot: tyro.conf.Positional[str]  # A robot file, or the name of a built-in robot.
    picture: Annotated[Path | None, optional("PNG", "none")] = None
    """PNG file with the robot at home, its table, and where its camera looks."""
    json: Flag = False  # Print one JSON object instead of text.

    def run(self) -> int:
        """Check, print, draw."""
        from dro_grasp.arm.robot_check import check_robot, draw_robot

        if self.picture is not None:
            check_output(self.picture, ".png")
        report = check_robot(self.robot)
        if self.picture is not None:
            draw_robot(report.robot, self.picture)
        print_report(report, self.picture, self.json)
        return 0 if report.usable else 2


@dataclass(frozen=True)
class Robots:
    """List the built-in robots. Any robot file works as well."""

    json: Flag = False  # Print one JSON object.

    def run(self) -> int:
        """Print the names."""
        from dro_grasp.arm.robots.loading import robot_names

        names = robot_names()
        print_result(self.json, {"robots": names}, "robots", ["name"], [[n] for n in names], "also: the path of a robot.yaml")
        return 0


@dataclass(frozen=True)
class RobotCommand:
    """Check and list robots: arms that carry a hand."""

    command: Annotated[CheckRobot, tyro.conf.subcommand("check")] | Annotated[Robots, tyro.conf.subcommand("list")]
