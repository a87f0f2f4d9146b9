"""`dro-grasp synthesize`: a grasp data set for any hand."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dro_grasp.cli.inputs import Flag, ProtocolName, optional
from dro_grasp.cli.output import print_result, say_aside

if TYPE_CHECKING:
    from dro_grasp.train.data.engine.pools import Pool
    from dro_grasp.train.data.engine.worker import Job


@dataclass(frozen=True)
class Synthesize:
    """Synthesize grasps from geometry alone, and keep those that pass a trial. A rerun resumes.

    Example: dro-grasp synthesize --hand my_hand.urdf --object bottle can --grasps 50 --output data
    """

    hand: tuple[str, ...]  # Names or paths of hands.
    object: tuple[str, ...]  # Names, meshes, folders of meshes, or groups such as builtin:train and assets:validate.
    output: Path  # Folder for the grasp files; created if missing.
    grasps: int = 150  # Valid grasps of each hand on each object. A rerun with a larger number adds the difference.
    minutes: Annotated[float | None, optional("MINUTES", "no limit")] = None
    """Start no new work after this time [min]. A rerun resumes."""
    workers: int = 2  # Processes of one thread each. A running Ray cluster uses all its CPUs instead.
    shard: Annotated[str, tyro.conf.arg(metavar="I/N", help_behavior_hint="(default: 1/1, all of them)")] = "1/1"
    """Part of the pairs that this run fills: 3/16 is the third of sixteen. All parts may share the folder and run at once, as
    the tasks of an array job."""
    engine: Literal["local", "ray"] = "local"  # Processes on this machine, or a Ray cluster.
    ray_address: Annotated[str | None, optional("HOST:PORT", "RAY_ADDRESS, or a new local cluster")] = None
    """Head of the Ray cluster, or `auto` for the cluster running on this machine."""
    device: str = "cpu"  # Device for the energies: cpu, cuda or cuda:1. Trials always run on the CPU.
    scale: float = 1.0  # Factor for the coordinates of the objects: 0.001 for millimetres.
    seed: int = 0  # The same seed gives the same grasps.
    protocol: ProtocolName = "strict"  # Protocol of the trial that grasps must pass.
    idle: float = 0.6
    """Probability that a finger other than the thumb is not asked to touch, 0 to 1; lower makes fuller grasps, and fewer."""
    keep_idle_fingers: Flag = False
    """Leave idle fingers as they are. Otherwise they close onto the object where the grasp then passes as well."""
    json: Flag = False  # Print one JSON object instead of a table.

    def run(self) -> int:
        """Check numbers and names, then fill the folder; the exit code is 2 if every pair fails and there is no grasp."""
        from dro_grasp.objects.catalogue import resolve_objects
        from dro_grasp.optimize.contacts import ContactConfig
        from dro_grasp.optimize.synthesis import SynthesisConfig
        from dro_grasp.train.data.engine.schedule import require_distinct, require_known, synthesize_dataset
        from dro_grasp.train.data.engine.worker import EngineConfig

        self._check_numbers()
        objects = resolve_objects(list(self.object))
        require_known(self.hand, objects)
        require_distinct(self.hand, objects)
        config = EngineConfig(
            self.protocol, self.scale, None if self.minutes is None else 60 * self.minutes, shard=self._part(),
            close_fingers=not self.keep_idle_fingers,
            synthesis=SynthesisConfig(device=self.device, contacts=ContactConfig(idle=self.idle)))
        report = synthesize_dataset(
            self.hand, objects, self.grasps, self.output, self._ray_pool if self.engine == "ray" else self.workers, self.seed,
            config, say_aside)
        failures = [{"hand": h, "object": o, "reason": why} for (h, o), why in report.failures.items()]
        counts = {"grasps": report.grasps, "added": report.added, "shards": report.shards, "seconds": round(report.seconds, 2)}
        code = 2 if failures and not report.grasps else 0
        print_result(self.json, {"output": str(self.output), **counts, "failures": failures}, "synthesis", [*counts],
                     [[*counts.values()]])
        if not self.json:
            for failure in failures:
                say_aside(f"{failure['hand']} on {failure['object']}: {failure['reason']}")
            if code:
                say_aside("error: no grasp was found, for the reasons above")
        return code

    def _check_numbers(self) -> None:
        from dro_grasp.errors import OptionError

        for option, value in (("--grasps", self.grasps), ("--workers", self.workers)):
            if value < 1:
                raise OptionError(f"{option} is {value}; give at least 1")
        if self.minutes is not None and not (math.isfinite(self.minutes) and self.minutes > 0):
            raise OptionError(f"--minutes is {self.minutes}; give a positive number, or leave it out for no limit")
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise OptionError(f"--scale is {self.scale}; give a positive number, for example 0.001 for millimetres")
        if not 0 <= self.idle <= 1:
            raise OptionError(f"--idle is {self.idle}; give a probability, from 0 (every finger holds) to 1")

    def _part(self) -> tuple[int, int]:
        from dro_grasp.errors import OptionError

        found = re.fullmatch(r"(\d+)/(\d+)", self.shard)
        if found is None:
            raise OptionError(f"--shard is '{self.shard}'; give a part from 1 on, and of how many, such as 3/16")
        return int(found[1]), int(found[2])

    def _ray_pool(self, job: Job) -> Pool:
        from dro_grasp.train.data.engine.pools import RayPool

        return RayPool(job, self.workers, job.config.shard_seconds, self.ray_address)
