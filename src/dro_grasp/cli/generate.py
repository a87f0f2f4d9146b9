"""`dro-grasp generate`: grasps of objects by a hand."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from dro_grasp.cli.output import print_json, print_table, progress_bar, stderr, stdout

if TYPE_CHECKING:
    from dro_grasp.grasps.batch import GraspBatch
    from dro_grasp.hands.hand import Hand
    from dro_grasp.objects.shape import ObjectModel
    from dro_grasp.predictor import GraspPredictor
    from dro_grasp.simulation.trial import TrialResult

ROWS_SHOWN = 16
"""Grasps listed in the table."""
Flag = tyro.conf.FlagCreatePairsOff[bool]


@dataclass(frozen=True)
class Generate:
    """Predict grasps of an object by a hand, try them in simulation, and save them.

    Example: dro-grasp generate --hand allegro --object mug --output grasps.parquet --picture grasps.png
    """

    hand: str
    """A hand's name (see `dro-grasp hands`) or the path of its URDF or MJCF file."""
    object: str
    """An object's name (see `dro-grasp objects`), a mesh, a point cloud (PLY, NPY, PCD), or a folder of them."""
    num: int = 16
    """How many grasps of each object."""
    seed: int = 0
    """The same seed gives the same grasps."""
    direction: tuple[float, float, float] | None = None
    """Palm direction in the object's frame: 0 0 -1 grasps from above."""
    table: float | None = None
    """Height [m] of a table in the object's frame; no hand goes below it."""
    scale: float = 1.0
    """Multiplies the object's coordinates; 0.001 for files in millimetres."""
    weights: str | None = None
    """Name of shipped weights (see `dro-grasp weights`) or the path of a weights file."""
    protocol: Literal["dro", "strict", "dro_static", "none"] | None = None
    """Trial that each grasp goes through; by default dro for a mesh and none for a bare point cloud."""
    only_successful: Flag = False
    """Save only the grasps that passed; the success rate still counts all."""
    output: Path | None = None
    """Parquet file for the grasps; with a folder of objects, one file an object in this folder."""
    picture: Path | None = None
    """PNG with pictures of the best grasps."""
    view: Flag = False
    """Open the viewer on the result."""
    json: Flag = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Check everything that can be checked before the work, then do it."""
        from dro_grasp.grasps.batch import check_output
        from dro_grasp.objects.library import resolve_objects
        from dro_grasp.predictor import GraspPredictor, check_request

        check_request(self.num, self.direction)
        names = resolve_objects([self.object])
        outputs = self._outputs(names)
        for path in [*outputs, self.picture]:
            if path is not None:
                check_output(path)
        begin = time.perf_counter()
        hand = _load_hand(self.hand)
        predictor = GraspPredictor(self.weights)
        load = time.perf_counter() - begin
        reports = [
            self._one(predictor, hand, name, path, load) for name, path in zip(names, outputs, strict=True)
        ]
        if self.json:
            print_json(reports[0] if len(reports) == 1 else {"results": reports})
        return 0

    def _outputs(self, names: list[str]) -> list[Path | None]:
        if self.output is None or len(names) == 1:
            return [self.output] * len(names)
        return [self.output / f"{Path(name).stem}.parquet" for name in names]

    def _one(
        self, predictor: GraspPredictor, hand: Hand, name: str, output: Path | None, load: float
    ) -> dict[str, Any]:
        """One object, start to end."""
        from dro_grasp.objects.library import load_object

        begin = time.perf_counter()
        obj = load_object(name, scale=self.scale)
        load += time.perf_counter() - begin
        for note in obj.notes:
            stderr.print(f"{obj.name}: {note}")
        with progress_bar("predicting", self.json) as progress:
            grasps = predictor.predict(hand, obj, self.num, self.seed, self.direction, self.table, progress)
        timings = dict(predictor.timings)
        begin = time.perf_counter()
        result, protocol = self._try(hand, obj, grasps)
        grasps = grasps if result is None else grasps.with_trial(result)
        seconds = {"load": load, **timings, "trial": time.perf_counter() - begin if result is not None else 0.0}
        kept = grasps if result is None or not self.only_successful else grasps[result.success]
        if output is not None:
            kept.save(output)
        if self.picture is not None:
            self._draw(hand, obj, kept if len(kept) else grasps)
        success = None if result is None else int(result.success.sum())
        report = {
            "hand": hand.name, "object": obj.name, "num": len(grasps), "candidates": predictor.candidates,
            "seed": self.seed, "weights": predictor.weights_name, "protocol": protocol, "success": success,
            "success_rate": None if success is None else success / len(grasps),
            "seconds": {k: round(v, 4) for k, v in seconds.items()},
            "output": None if output is None else str(output),
        }
        if not self.json:
            self._show(report, grasps, result)
        if self.view:
            from dro_grasp.viewer.app import view_grasps

            view_grasps(hand, obj, kept)
        return report

    def _try(self, hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> tuple[TrialResult | None, str]:
        protocol = self.protocol or ("none" if obj.is_cloud else "dro")
        if protocol == "none":
            return None, protocol
        from dro_grasp.simulation.trial import simulate

        with progress_bar("trying", self.json) as progress:
            result = simulate(hand, obj, grasps, protocol, progress=progress)
        return result, protocol

    def _draw(self, hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> None:
        from dro_grasp.viewer.pictures import draw_grasps

        assert self.picture is not None
        draw_grasps(hand, obj, grasps, self.picture)

    def _show(self, report: dict[str, Any], grasps: GraspBatch, result: TrialResult | None) -> None:
        rows = []
        for i in range(min(len(grasps), ROWS_SHOWN)):
            score = None if grasps.score is None else float(grasps.score[i])
            tried = [None] * 4 if result is None else [
                bool(result.success[i]), int(result.contacts[i]), float(result.penetration[i]) * 1e3, result.reason[i],
            ]
            rows.append([i, score, *tried])
        columns = ["grasp", "score", "success", "contacts", "penetration [mm]", "reason"]
        seconds = "  ".join(f"{k} {v:.2f} s" for k, v in report["seconds"].items())
        print_table(f"{report['hand']} on {report['object']}", columns, rows, note=seconds)
        if result is not None:
            stdout.print(f"{report['success']} of {report['num']} grasps succeeded under protocol {report['protocol']}")
        if report["output"]:
            stdout.print(f"grasps: {report['output']}")
        if self.picture is not None:
            stdout.print(f"picture: {self.picture}")


def _load_hand(name: str) -> Hand:
    from dro_grasp.hands.library import load_hand

    return load_hand(name)
