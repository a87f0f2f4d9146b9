"""`dro-grasp tabletop`: lifts from camera clouds, carried out with physics."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from dro_grasp.cli.inputs import Flag, PalmOptions, optional
from dro_grasp.cli.output import print_json, print_table, say, say_aside

if TYPE_CHECKING:
    from dro_grasp.planning.attempts import Attempt


@dataclass(frozen=True)
class Tabletop:
    """Let a robot see, plan, grasp, lift, hold and shake objects on its table, in MuJoCo. Needs the extra `[arm]`.

    Example: dro-grasp tabletop --robot xarm7_leaphand --objects mug can --attempts 2 --output results.parquet
    """

    robot: str
    """A robot file, or the name of a built-in robot (see `dro-grasp robot list`)."""
    objects: tuple[str, ...]
    """Names or files of meshes, `all`, or `assets:validate`."""
    attempts: int = 10
    """With each object, each at another place and in another pose."""
    see: Literal["cloud", "mesh"] = "cloud"
    """What is planned for: the robot's camera's cloud alone, or, as a control, the true mesh at its true place."""
    order: Literal["score", "random"] = "score"
    """Which reachable grasps are taken: the best by score, or, as a control, any."""
    directions: Literal["paper", "all"] = "all"
    """Palm directions: `paper`, from above to the right side, or `all`."""
    constraints: PalmOptions = field(default_factory=PalmOptions)
    """In the world frame."""
    num: int = 24
    """Grasps to choose from, in each of up to three batches."""
    rehearsals: int = 8
    """Grasps of each batch whose lift is simulated on the object as it is known, before one is chosen; 0 for none."""
    region: Annotated[tuple[float, float, float, float] | None, optional("X0 Y0 X1 Y1", "0.38 -0.18 0.58 0.18")] = None
    """Where objects are put, from corner to corner about the arm's base [m]; a small arm needs them nearer."""
    clutter: int = 0
    """Other objects, drawn from the built-in ones, that stand around the one that is asked for: 2 to 4 make a crowd."""
    segment: Literal["cluster", "mask"] = "cluster"
    """How the object's points are told from those of others: by distance, or by its true mask."""
    noise: float = 0.0015
    """Standard deviation of the camera's depth [m]."""
    seed: int = 0
    """Of all draws."""
    weights: Annotated[str | None, optional("NAME|PATH", "the shipped weights")] = None
    """Name of shipped weights (see `dro-grasp weights list`) or the path of a weights file."""
    workers: int = 1
    """Processes; each takes one object after the other."""
    output: Annotated[Path | None, optional("PARQUET", "not saved")] = None
    """A row for each attempt, with stage, reason, times and seed. Attempts that it holds with the same robot, objects, weights,
    settings and seed are not repeated."""
    plans: Annotated[Path | None, optional("FOLDER", "not saved")] = None
    """Folder for the plan of each attempt, ROBOT-OBJECT-NUMBER.npz."""
    video: Annotated[Path | None, optional("GIF|WEBP", "none")] = None
    """Animation of the first attempt, which is run once more for it."""
    json: Flag = False
    """Print one JSON object instead of text."""

    def run(self) -> int:
        """Run what is missing, store and print."""
        from dro_grasp.extras import require_extra

        require_extra("arm")
        from dro_grasp.objects.catalogue import resolve_objects
        from dro_grasp.planning.animation import check_animation, draw_attempt
        from dro_grasp.planning.attempts import TabletopConfig
        from dro_grasp.planning.planner import PlanConfig
        from dro_grasp.planning.tabletop import TabletopRun, run_tabletop

        if self.video is not None:
            check_animation(self.video)
        config = TabletopConfig(
            self.see, self.noise, self.region or TabletopConfig.region, clutter=self.clutter, segment=self.segment,
            plan=PlanConfig(
                self.num, directions=self.directions, order=self.order, rehearsals=self.rehearsals,
                constraints=self.constraints.constraints()))
        run = TabletopRun(
            self.robot, tuple(resolve_objects(list(self.objects))), self.attempts, self.seed, self.weights, config)
        done = run_tabletop(run, self.output, self.workers, None if self.json else _say, self.plans)
        self._report(done)
        if self.video is not None:
            draw_attempt(run, self.video)
            say_aside(f"video: {self.video}")
        return 0

    def _report(self, done: list[Attempt]) -> None:
        from dro_grasp.compare.metrics import wilson_interval
        from dro_grasp.planning.tabletop import endings, failures, processor_seconds

        held = sum(a.success for a in done)
        low, high = wilson_interval(held, len(done))
        seconds = processor_seconds(done)
        if self.json:
            print_json({
                "robot": done[0].robot, "attempts": len(done), "success": held, "success_rate": held / len(done),
                "interval": [low, high], "ended": endings(done), "processor_seconds": seconds, "failures": failures(done)})
            return
        rows = []
        for name in dict.fromkeys(a.object for a in done):
            own = [a for a in done if a.object == name]
            ended = ", ".join(f"{stage} {count}" for stage, count in endings(own).items())
            rows.append([name, f"{sum(a.success for a in own)} of {len(own)}", ended])
        print_table(f"{done[0].robot}: lifts", ["object", "held", "ended in"], rows)
        say(f"{held} of {len(done)} attempts succeeded ({held / len(done):.0%}, 95 % interval {low:.0%} to {high:.0%})")
        if seconds:
            say(f"depth image to timed plan, time of one core: median {seconds['median']:.1f} s, 95 % within "
                f"{seconds['within_95']:.1f} s (n = {seconds['n']})")
        if self.output is not None:
            say(f"attempts: {self.output}")


def _say(attempt: Attempt) -> None:
    """One line on stderr."""
    outcome = "held" if attempt.success else f"{attempt.stage}: {attempt.reason}"
    say_aside(f"{attempt.object}, attempt {attempt.number}: {outcome}")
