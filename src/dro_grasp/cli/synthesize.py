"""`dro-grasp synthesize`: grasp data for any hand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dro_grasp.cli.output import optional, print_json, print_table, say_aside

if TYPE_CHECKING:
    from dro_grasp.datasets.pools import Pool
    from dro_grasp.datasets.production import Job


@dataclass(frozen=True)
class Synthesize:
    """Make grasps from geometry alone and keep those that pass a trial; a rerun goes on where it stopped.

    Example: dro-grasp synthesize --hand my_hand.urdf --object mug bottle --grasps 50 --output data
    """

    hand: tuple[str, ...]
    """Hands: names or paths."""
    object: tuple[str, ...]
    """Objects: names, meshes, folders of meshes, or groups such as builtin:train and assets:validate."""
    output: Path
    """Folder for the grasp files; its parent must exist."""
    grasps: int = 150
    """Valid grasps of each hand and object; a rerun with more adds the rest."""
    minutes: Annotated[float | None, optional("MINUTES", "no limit")] = None
    """Begin no more work after this time; a rerun goes on."""
    workers: int = 2
    """Processes of one thread each; on a running Ray cluster, all of its CPUs are used instead."""
    engine: Literal["local", "ray"] = "local"
    """Where the work is done: processes of this machine, or a Ray cluster."""
    ray_address: Annotated[str | None, optional("HOST:PORT", "RAY_ADDRESS, or a new one here")] = None
    """Head of the Ray cluster; `auto` for the one that runs on this machine."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where energies are computed; trials always run on the CPU."""
    scale: float = 1.0
    """Multiplies the coordinates of the objects: 0.001 for millimetres."""
    seed: int = 0
    """The same seed gives the same grasps."""
    protocol: Literal["strict", "dro"] = "strict"
    """Trial that grasps must pass."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Check names first, then fill the folder."""
        from dro_grasp.datasets.engine import EngineConfig, synthesize_dataset
        from dro_grasp.grasps.synthesis import SynthesisConfig
        from dro_grasp.hands.library import locate_hand
        from dro_grasp.objects.library import resolve_objects

        for name in self.hand:
            locate_hand(name)
        objects = resolve_objects(list(self.object))
        report = synthesize_dataset(
            self.hand, objects, self.grasps, self.output, workers=self.workers, seed=self.seed, protocol=self.protocol,
            config=EngineConfig(synthesis=SynthesisConfig(device=self.device)), scale=self.scale, progress=say_aside,
            make_pool=self._ray_pool if self.engine == "ray" else None,
            seconds=None if self.minutes is None else 60 * self.minutes,
        )
        failures = [{"hand": h, "object": o, "reason": why} for (h, o), why in report.failures.items()]
        values = {"output": str(self.output), "grasps": report.grasps, "added": report.added, "shards": report.shards,
                  "seconds": round(report.seconds, 2), "failures": failures}
        if self.json:
            print_json(values)
            return 0
        print_table("synthesis", ["grasps", "added", "shards", "seconds"],
                    [[report.grasps, report.added, report.shards, report.seconds]])
        for failure in failures:
            say_aside(f"{failure['hand']} on {failure['object']}: {failure['reason']}")
        return 0

    def _ray_pool(self, job: Job) -> Pool:
        from dro_grasp.datasets.ray_pool import RayPool

        return RayPool(job, self.workers, job.config.shard_limit, self.ray_address)
