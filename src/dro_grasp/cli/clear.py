"""`dro-grasp clear`: a robot clears its table into a bin, in simulation."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from dro_grasp.cli.inputs import Flag, Friction, optional
from dro_grasp.cli.output import print_json, print_table, say, say_aside, say_file
from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.extras import require_extra
from dro_grasp.files import UNTYPED, check_output, reading, replacing
from dro_grasp.kinds import require_seed

if TYPE_CHECKING:
    from dro_grasp.arm.clearing.loop import Pick
    from dro_grasp.arm.clearing.record import ClearRecorder
    from dro_grasp.arm.clearing.trial import ClearTrialConfig
    from dro_grasp.arm.robots.robot import Robot


VIDEO_EVERY = 4  # The animation shows each fourth moment that is recorded, and is four times as fast (ours)


@dataclass(frozen=True)
class Clear:
    """Let a robot clear its table into a bin, one thing after the other, in MuJoCo. Needs the extra `[arm]`.

    It looks, picks what has most room, checks by its joints whether it holds, drops it into the bin, and looks again. What it
    loses it tries again with another grasp.

    Example: dro-grasp clear --robot xarm7_leaphand --objects mug can bottle --output tables.jsonl --video clear.webp
    """

    robot: str  # A robot file, or the name of a built-in robot (see `dro-grasp robot list`).
    objects: tuple[str, ...]  # Names or files of meshes, or groups such as builtin:train, of which each table is drawn.
    things: Annotated[int | None, optional("INT", "all")] = None  # How many stand on a table.
    tables: int = 1  # How many tables are cleared.
    bin: Annotated[
        tuple[float, float, float, float, float] | None, optional("X Y LX LY HEIGHT", "0.3 0.5 0.36 0.3 0.08")] = None
    """Middle and extents of the bin, and the height of its walls, in the world [m]."""
    tries: int = 3  # Picks of a thing that may fail before it is given up.
    num: int = 8  # Grasps that are asked for, in each of up to three batches; each is tried as soon as it is known.
    rehearsals: int = 8  # Grasps of each batch whose lift is simulated on the object as it is known; 0 for none.
    friction: Friction = 0.5
    seed: int = 0  # Seed of all draws.
    weights: Annotated[str | None, optional("NAME|PATH", "the shipped weights")] = None
    """Name of shipped weights (see `dro-grasp weights list`) or the path of a weights file."""
    output: Annotated[Path | None, optional("JSONL", "not saved")] = None
    """File for a line a table. A rerun repeats no table that it holds with the same robot, objects, weights, settings and
    seed."""
    video: Annotated[Path | None, optional("GIF|WEBP", "none")] = None
    """Animation of the first table, four times as fast; the table is cleared for it."""
    record: Annotated[Path | None, optional("NPZ", "not kept")] = None
    """The first table, kept moment by moment: `dro-grasp view` plays it. The table is cleared for it."""
    json: Flag = False  # Print one JSON object instead of text.

    def run(self) -> int:
        """Clear what is missing, store and print."""
        from dro_grasp.arm.clearing.record import ClearRecorder
        from dro_grasp.arm.clearing.trial import clear_trial
        from dro_grasp.arm.robots.loading import load_robot
        from dro_grasp.arm.tabletop.animation import FORMATS
        from dro_grasp.arm.tabletop.experiment import require_mesh
        from dro_grasp.network.checkpoints import describe_weights
        from dro_grasp.objects.catalogue import load_object, resolve_objects
        from dro_grasp.predict.predictor import GraspPredictor

        require_extra("arm")
        if self.video is not None:
            check_output(self.video, *FORMATS)
        if self.output is not None:
            check_output(self.output, ".jsonl")
        if self.record is not None:
            check_output(self.record, ".npz")
        require_seed(self.seed, 31)
        names = resolve_objects(list(self.objects))
        count = len(names) if self.things is None else self.things
        if self.tables < 1 or not 1 <= count <= len(names):
            tables, things = _counted(self.tables, "table"), _counted(count, "thing")
            raise OptionError(f"{tables} of {things} {'is' if self.tables == 1 else 'are'} asked for, of "
                              f"{_counted(len(names), 'object')}; give at least one table, and no more things than objects")
        objects = [load_object(name) for name in names]
        for obj in objects:
            require_mesh(obj)
        config, robot = self._config(), load_robot(self.robot)
        key = {"robot": robot.sha256, "objects": [obj.sha256 for obj in objects], "things": count,
               "seed": self.seed, "weights": describe_weights(self.weights)["sha256"], "settings": asdict(config)}
        known = _read(self.output, json.loads(json.dumps(key)))
        predictor = GraspPredictor(self.weights)
        done, first = list[dict[str, Any]](), None
        for number in range(self.tables):
            kept = number == 0 and (self.video is not None or self.record is not None)
            if number not in known or kept:
                recorder = ClearRecorder() if kept else None
                first = first or recorder

                def picked(pick: Pick, recorder: ClearRecorder | None = recorder) -> None:
                    if recorder is not None:
                        recorder.picked(pick)
                    if not self.json:
                        _say(pick)

                drawn = [objects[i] for i in _drawn(len(names), count, self.seed, number)]
                made = clear_trial(robot, drawn, number, self.seed, predictor, config, recorder, picked)
                known[number] = asdict(made)
                _append(self.output, {"table": number, **asdict(made), "key": key})
            done.append(known[number])
        self._report(done)
        if first is not None:
            self._keep(robot, first)
        return 0

    def _config(self) -> ClearTrialConfig:
        from dro_grasp.arm.clearing.loop import Bin, ClearConfig
        from dro_grasp.arm.clearing.trial import ClearTrialConfig
        from dro_grasp.arm.planning.task import PlanConfig

        box = Bin() if self.bin is None else Bin(self.bin[:2], self.bin[2:4], self.bin[4])
        plan = PlanConfig(self.num, rehearsals=self.rehearsals, friction=self.friction)
        return ClearTrialConfig(friction=self.friction, clear=ClearConfig(box, self.tries, plan=plan))

    def _keep(self, robot: Robot, recorder: ClearRecorder) -> None:
        """Write what was recorded, and its animation."""
        from dro_grasp.arm.tabletop.animation import draw_animation

        if self.record is not None:
            recorder.record(robot).save(self.record)
            say_aside(f"record: {self.record} (dro-grasp view {self.record} plays it)")
        if self.video is not None:
            draw_animation(robot, replace(recorder, frames=recorder.frames[::VIDEO_EVERY]), self.video)
            say_file("video", self.video, aside=True)

    def _report(self, done: list[dict[str, Any]]) -> None:
        from dro_grasp.compare.metrics import wilson_interval

        things = sum(len(table["objects"]) for table in done)
        removed, picks = sum(sum(table["removed"]) for table in done), sum(len(table["cleared"]["picks"]) for table in done)
        judged = [(state == "held", held) for table in done for state, held in table["judgements"]]
        right = sum(said == held for said, held in judged)
        low, high = wilson_interval(removed, things)
        if self.json:
            print_json({"tables": len(done), "things": things, "removed": removed, "interval": [low, high], "picks": picks,
                        "judgements": len(judged), "right": right, "results": done})
            return
        rows = [[i, f"{sum(table['removed'])} of {len(table['objects'])}", len(table["cleared"]["picks"]),
                 len(table["cleared"]["left"]), table["reason"]] for i, table in enumerate(done)]
        print_table("tables", ["table", "removed", "picks", "given up", "ended by"], rows)
        for i, table in enumerate(done):
            for pick in table["cleared"]["left"]:
                say(f"table {i}, thing at ({pick['place'][0]:.2f}, {pick['place'][1]:.2f}) m: {pick['reason']}")
        say(f"{removed} of {things} things removed ({removed / things:.0%}, 95 % interval {low:.0%} to {high:.0%})"
            + (f", with {picks / removed:.2f} picks each" if removed else ""))
        if judged:
            low, high = wilson_interval(right, len(judged))
            say(f"whether it holds: {right} of {len(judged)} judgements are right ({right / len(judged):.0%}, 95 % interval "
                f"{low:.0%} to {high:.0%})")
        if self.output is not None:
            say_file("tables", self.output)


def _drawn(total: int, count: int, seed: int, number: int) -> list[int]:
    """Which objects stand on a table."""
    import numpy as np

    return np.random.default_rng([seed, number, 7]).permutation(total)[:count].tolist()


def _read(path: Path | None, key: dict[str, Any]) -> dict[int, dict[str, Any]]:
    """Tables of the same key in a file, by number."""
    if path is None or not path.exists():
        return {}
    with reading(path, GraspFileError, "a file of cleared tables (.jsonl); name another one, or move this one away", *UNTYPED):
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
        return {line.pop("table"): line for line in lines if line.pop("key") == key}


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _append(path: Path | None, line: dict[str, Any]) -> None:
    if path is None:
        return
    before = path.read_text(encoding="utf-8") if path.exists() else ""
    with replacing(path, "tables") as temporary:
        temporary.write_text(before + json.dumps(line) + "\n", encoding="utf-8")


def _say(pick: Pick) -> None:
    x, y = pick.place
    say_aside(f"thing at ({x:.2f}, {y:.2f}) m: {'in the bin' if not pick.reason else f'{pick.stage}: {pick.reason}'}")
