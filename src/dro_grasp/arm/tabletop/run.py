"""Attempts with many objects: those that a file does not hold yet, each stored when it ends."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from pebble import ProcessExpired, ProcessPool

from dro_grasp.arm.planning.motion import MotionPlan
from dro_grasp.arm.robots.loading import load_robot
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.arm.tabletop.attempts import Attempt, read_attempts, sole_writer, write_attempts
from dro_grasp.arm.tabletop.experiment import TabletopConfig, Watcher, attempt, require_mesh
from dro_grasp.arm.tabletop.table_scene import PickedObject
from dro_grasp.devices import cores
from dro_grasp.errors import OptionError
from dro_grasp.extras import require_extra
from dro_grasp.files import check_output, make_folder
from dro_grasp.kinds import Checked, checked, require_positive
from dro_grasp.network.checkpoints import DEFAULT, describe_weights
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.workers import use_one_thread


@dataclass(frozen=True)
class TabletopRun(Checked):
    """What is attempted."""

    robot: str
    """Name or file."""
    objects: tuple[str, ...]
    """Names or files of meshes."""
    attempts: int = 10
    """Attempts with each object. Source: paper, real-robot experiment."""
    seed: int = 0
    """Seed of all draws."""
    weights: str | None = None
    """Name or file of weights; the shipped ones by default."""
    config: TabletopConfig = field(default_factory=TabletopConfig)
    """How attempts run."""

    def __post_init__(self) -> None:
        """Refuse what cannot be run.

        Raises:
            OptionError: No attempts, or no objects, or a seed that is none.
        """
        super().__post_init__()
        if not 0 <= self.seed < 2**31:
            raise OptionError(f"seed is {self.seed}; give an integer from 0 to 2^31 - 1")
        if self.attempts < 1 or not self.objects:
            raise OptionError(f"{self.attempts} attempts on {len(self.objects)} objects; ask for at least one of each")


@dataclass
class PlanKeeper(Watcher):
    """Stores the plan of an attempt."""

    path: Path

    def planned(self, seen: PickedObject, made: MotionPlan) -> None:
        """Write it."""
        made.save(self.path)


@checked
def run_tabletop(
    run: TabletopRun, output: Path | None = None, workers: int = 1, progress: Callable[[Attempt], None] | None = None,
    plans: Path | None = None, make: Callable[..., Attempt] | None = None,
) -> list[Attempt]:
    """Run all attempts that `output` does not hold yet; each is stored when it ends.

    Args:
        run: What is attempted.
        output: Parquet file; attempts with the same robot, objects, weights, settings and seed in it are not repeated, others
            stay. Files of the same names count as the same only if their contents are.
        workers: Processes, which share out the attempts; with several, each is stored as it ends.
        progress: Called after each attempt.
        plans: Folder for the plan of each attempt, ROBOT-OBJECT-NUMBER.npz.
        make: Makes one, instead of `attempt`, with the same arguments.

    Raises:
        OptionError: The extra is missing, something cannot be attempted, or two objects have one name.
        RobotError: The robot cannot be used.
        ObjectError: An object cannot be used.
        WeightsError: The weights cannot be used.
        GraspFileError: `output` is there and is no such file.
        OutputError: `output` or `plans` cannot be written, or another run is storing attempts in `output`.
    """
    require_extra("arm")
    require_positive(workers=workers)
    output = None if output is None else check_output(output, ".parquet")
    with nullcontext() if output is None else sole_writer(output):
        return _run_tabletop(run, output, workers, progress, plans, make or attempt)


def _run_tabletop(
    run: TabletopRun, output: Path | None, workers: int, progress: Callable[[Attempt], None] | None, plans: Path | None,
    make: Callable[..., Attempt],
) -> list[Attempt]:
    stored = read_attempts(output) if output is not None and output.exists() else []
    done, names = _done(run, stored, output)
    missing = {o: [k for k in range(run.attempts) if (n, k) not in done] for o, n in names.items()}
    if plans is not None:
        make_folder(plans)
    for result in _results(run, {o: numbers for o, numbers in missing.items() if numbers}, workers, plans, make):
        stored.append(result)
        done[result.object, result.number] = result
        if output is not None:
            write_attempts(stored, output)
        if progress is not None:
            progress(result)
    return [done[n, k] for n in names.values() for k in range(run.attempts)]


def _done(
    run: TabletopRun, stored: Sequence[Attempt], output: Path | None
) -> tuple[dict[tuple[str, int], Attempt], dict[str, str]]:
    """The attempts of a run that are stored, by object and number; and the name of each object that is given, once each."""
    robot, weights, objects = load_robot(run.robot), describe_weights(run.weights)["sha256"], _objects(run.objects)
    alike = [a for a in stored if (a.robot, a.settings, a.seed) == (robot.name, run.config.label(), run.seed)]
    done = [a for a in alike if (a.robot_sha256, a.weights_sha256) == (robot.sha256, weights)]
    for a in done:
        source, sha256, solid = objects.get(a.object, ("", a.object_sha256, a.solid_sha256))
        if (a.object_sha256, a.solid_sha256) != (sha256, solid):
            raise OptionError(f"'{source}' is not the object '{a.object}' of the attempts in {output}, made with "
                              f"'{a.object_file}' as it was then; rename the file, or attempt it apart, with another "
                              "output=... and plans=...")
    return {(a.object, a.number): a for a in done}, {source: name for name, (source, *_) in objects.items()}


def _objects(given: Sequence[str]) -> dict[str, tuple[str, str, str]]:
    """What each object was given as, and its hashes, by its name; a bare cloud is refused."""
    found: dict[str, tuple[str, str, str]] = {}
    for source in dict.fromkeys(given):
        obj = load_object(source)
        require_mesh(obj)
        first, _, solid = found.setdefault(obj.name, (source, obj.sha256, obj.solid_sha256))
        if obj.solid_sha256 != solid:
            raise OptionError(f"'{first}' and '{source}' are different objects of the name '{obj.name}', under which attempts "
                              "and plans are stored; rename one of the files, or attempt them apart, each with its own "
                              "output=... and plans=...")
    return found


def _results(
    run: TabletopRun, missing: dict[str, list[int]], workers: int, plans: Path | None, make: Callable[..., Attempt]
) -> Iterator[Attempt]:
    tasks = [(run, name, number, plans, make) for name, numbers in missing.items() for number in numbers]
    if workers <= 1 or len(tasks) <= 1:
        for name, numbers in missing.items():
            loaded = _load(run.robot, name, run.weights)
            yield from (_attempted(run, loaded, name, number, plans, make) for number in numbers)
        return
    faults = list[Exception]()
    pool = ProcessPool(min(workers, len(tasks)), initializer=use_one_thread, initargs=(max(1, cores() // workers),),
                       context=multiprocessing.get_context("spawn"))
    try:
        futures: list[Future[Attempt]] = [pool.schedule(_attempted_apart, task) for task in tasks]
        for future in as_completed(futures):
            try:
                made = future.result()
            except Exception as fault:  # the others are made and stored before it is told
                faults.append(fault)
            else:
                yield made
    finally:
        pool.stop()
        pool.join()
    if faults:
        raise _explained(faults[0], workers)


def _explained(fault: Exception, workers: int) -> Exception:
    """A fault in words, where it is none of ours."""
    if not isinstance(fault, ProcessExpired | BrokenProcessPool):
        return fault
    code = f" (exit code {fault.exitcode})" if isinstance(fault, ProcessExpired) else ""
    return OptionError(f"one of {workers} processes died over its attempt{code}, perhaps for want of memory; ask for fewer "
                       "(workers=...). The attempts that ended are stored, and the same run makes what is missing")


Loaded = tuple[Robot, ObjectModel, GraspPredictor]  # What attempts with an object share


def _load(robot: str, obj: str, weights: str | None) -> Loaded:
    return load_robot(robot), load_object(obj), GraspPredictor(weights)


_kept = lru_cache(maxsize=2)(_load)  # In a worker, whose attempts with an object mostly follow each other


def _attempted_apart(run: TabletopRun, name: str, *others: Any) -> Attempt:
    return _attempted(run, _kept(run.robot, name, run.weights), name, *others)


def _attempted(
    run: TabletopRun, loaded: Loaded, name: str, number: int, plans: Path | None, make: Callable[..., Attempt]
) -> Attempt:
    robot, obj, predictor = loaded
    keeper = None if plans is None else PlanKeeper(plans / f"{robot.name}-{obj.name}-{number}.npz")
    return replace(
        make(robot, obj, number, run.seed, predictor, run.config, keeper), robot_file=robot.source, object_file=str(name),
        weights=str(run.weights or DEFAULT), robot_sha256=robot.sha256, object_sha256=obj.sha256,
        weights_sha256=describe_weights(run.weights)["sha256"], solid_sha256=obj.solid_sha256)
