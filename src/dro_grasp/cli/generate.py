"""`dro-grasp generate`: grasps of objects by a hand."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from dro_grasp.cli.output import optional, print_json, print_table, progress_bar, say, say_aside
from dro_grasp.grasps.sources import with_sources

if TYPE_CHECKING:
    from torch import Tensor

    from dro_grasp.frames import NamedMotion
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
    candidates: int = 4
    """Grasps that are predicted for each one that is kept; the best by score are. 1 is quickest."""
    seed: int = 0
    """The same seed gives the same grasps."""
    direction: Annotated[tuple[float, float, float] | None, optional("X Y Z", "any direction")] = None
    """Palm direction in the object's frame: 0 0 -1 grasps from above."""
    table: Annotated[float | None, optional("Z", "no table")] = None
    """Height [m] of a table in the object's frame; no hand goes below it."""
    camera: Annotated[Path | None, optional("JSON", "the object's own frame")] = None
    """File with {"frame": "base", "T_frame_camera": 4x4}: the object is a cloud in that camera's frame, and is cleaned; grasps,
    direction and table are in the frame named."""
    refine: bool = True
    """Polish the network's grasps on the object's geometry, near where they were predicted."""
    temperature: Annotated[float | None, optional("T", "as the weights say")] = None
    """How varied the grasps of one placement are: 0 takes the likeliest, 1 all that the weights have learned."""
    scale: float = 1.0
    """Multiplies the object's coordinates; 0.001 for files in millimetres."""
    weights: Annotated[str | None, optional("NAME|PATH", "the shipped weights")] = None
    """Name of shipped weights (see `dro-grasp weights list`) or the path of a weights file."""
    protocol: Annotated[
        Literal["dro", "strict", "dro_static", "dexgraspbench", "none"] | None,
        optional("{dro,strict,dro_static,dexgraspbench,none}", "dro for a mesh, none for a bare point cloud"),
    ] = None
    """Trial that each grasp goes through."""
    only_successful: Flag = False
    """Save only the grasps that passed; the success rate still counts all."""
    output: Annotated[Path | None, optional("PATH", "not saved")] = None
    """Parquet file for the grasps; with a folder of objects, an existing folder that gets one file an object."""
    picture: Annotated[Path | None, optional("PNG", "no picture")] = None
    """Picture of the best grasps; with a folder of objects, an existing folder."""
    view: Flag = False
    """Open the viewer on the result."""
    json: Flag = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Check everything that can be checked before the work, then do it."""
        from dro_grasp.errors import DroGraspError
        from dro_grasp.frames import read_motion
        from dro_grasp.hands.library import load_hand
        from dro_grasp.objects.catalogue import resolve_objects
        from dro_grasp.predictor import GraspPredictor, PredictorConfig, check_request

        check_request(self.num, self.direction, self.temperature, self.candidates)
        check_seed(self.seed)
        check_table(self.table)
        names = resolve_objects([self.object])
        several = names != [self.object]
        outputs = paths_per_object(self.output, names, several, ".parquet")
        pictures = paths_per_object(self.picture, names, several, ".png")
        camera = None if self.camera is None else read_motion(self.camera, "T_frame_camera")
        begin = time.perf_counter()
        hand = load_hand(self.hand)
        predictor = GraspPredictor(self.weights, config=PredictorConfig(temperature=self.temperature))
        load = time.perf_counter() - begin
        jobs = zip(names, outputs, pictures, strict=True)
        done, failed = [], []
        for name, output, picture in jobs:
            try:
                done.append(self._one(predictor, hand, name, camera, output, picture, load))
            except DroGraspError as error:
                if not several:
                    raise
                say_aside(f"error: {name}: {error}")
                failed.append({"object": name, "error": str(error)})
        if self.json:
            print_json({"results": [d.report for d in done], "failed": failed} if several else done[0].report)
        if self.view:
            from dro_grasp.viewer.app import view_grasps

            for d in done:
                view_grasps(hand, d.obj, d.grasps, d.predicted_points)
        return 2 if failed else 0

    def _one(
        self, predictor: GraspPredictor, hand: Hand, name: str, camera: NamedMotion | None, output: Path | None,
        picture: Path | None, load: float,
    ) -> Done:
        """One object, start to end."""
        from dro_grasp.objects.catalogue import load_object
        from dro_grasp.perception.scan import load_scan

        begin = time.perf_counter()
        if camera is None:
            obj = load_object(name, scale=self.scale)
        else:
            obj = load_scan(Path(name).expanduser(), camera.T.double().numpy(), self.scale)
        load += time.perf_counter() - begin
        for note in obj.notes:
            say_aside(f"{obj.name}: {note}")
        with progress_bar("predicting", self.json) as progress:
            grasps = predictor.predict(
                hand, obj, self.num, self.seed, self.direction, self.table, self.refine, progress, self.candidates)
        points, timings = predictor.predicted_points, dict(predictor.timings)
        begin = time.perf_counter()
        result, protocol = self._try(hand, obj, grasps)
        grasps = grasps if result is None else grasps.with_trial(result)
        seconds = {"load": load, **timings, "trial": time.perf_counter() - begin if result is not None else 0.0}
        report = {
            "hand": hand.name, "object": obj.name, "num": len(grasps), "candidates": predictor.candidates,
            "seed": self.seed, "weights": predictor.weights_name, "protocol": protocol,
            "success": None if result is None else int(result.success.sum()),
            "success_rate": None if result is None else result.success_rate,
            "seconds": {k: round(v, 4) for k, v in seconds.items()},
            "output": None if output is None else str(output),
            "frame": "object" if camera is None else camera.frame,
        }
        kept = grasps
        if result is not None and self.only_successful:
            kept, points = grasps[result.success], None if points is None else points[result.success]
        if output is not None:
            with_sources(kept, self.hand, name, self.scale, camera).save(output)
        if picture is not None:
            from dro_grasp.viewer.pictures import draw_grasps

            report["picture"] = str(picture)
            draw_grasps(hand, obj, kept if len(kept) else grasps, picture)
        if not self.json:
            self._show(report, grasps, result)
        return Done(report, obj, kept, points)

    def _try(self, hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> tuple[TrialResult | None, str]:
        protocol = self.protocol or ("none" if obj.is_cloud else "dro")
        if protocol == "none":
            return None, protocol
        from dro_grasp.simulation.trial import simulate

        with progress_bar("trying", self.json) as progress:
            result = simulate(hand, obj, grasps, protocol, progress=progress)
        return result, protocol

    def _show(self, report: dict[str, Any], grasps: GraspBatch, result: TrialResult | None) -> None:
        rows = []
        for i in range(min(len(grasps), ROWS_SHOWN)):
            score = float(grasps.score[i])
            tried = [None] * 4 if result is None else [
                bool(result.success[i]), int(result.contacts[i]), float(result.penetration[i]) * 1e3, result.reason[i],
            ]
            rows.append([i, score, *tried])
        columns = ["grasp", "score", "success", "contacts", "penetration [mm]", "reason"]
        seconds = "  ".join(f"{k} {v:.2f} s" for k, v in report["seconds"].items())
        print_table(f"{report['hand']} on {report['object']}", columns, rows, note=seconds)
        if result is not None:
            say(f"{report['success']} of {report['num']} grasps succeeded under protocol {report['protocol']}")
        for what, key in (("grasps", "output"), ("picture", "picture")):
            if report.get(key):
                say(f"{what}: {report[key]}")


@dataclass(frozen=True)
class Done:
    """What one object led to."""

    report: dict[str, Any]
    """The JSON object."""
    obj: ObjectModel
    grasps: GraspBatch
    """The grasps that were kept."""
    predicted_points: Tensor | None
    """Their hand points as the network placed them."""


def check_seed(seed: int) -> None:
    """Refuse seeds that the random generators cannot take."""
    from dro_grasp.errors import OptionError

    if not 0 <= seed < 2**63:
        raise OptionError(f"seed is {seed}; give an integer from 0 to 2^63 - 1")


def check_table(table: float | None) -> None:
    """Refuse a height that is no number."""
    from dro_grasp.errors import OptionError

    if table is not None and not math.isfinite(table):
        raise OptionError(f"table is {table}; give the height in metres, for example --table 0")


def paths_per_object(path: Path | None, names: list[str], several: bool, suffix: str) -> list[Path | None]:
    """Where each object's file goes, checked before the work: the path itself, or files in the folder that it names."""
    from dro_grasp.errors import OutputError
    from dro_grasp.files import check_output

    if path is None:
        return [None] * len(names)
    if not several and path.suffix.lower() not in {"", suffix}:
        raise OutputError(f"{path} would hold {suffix[1:]} under another ending; call it {path.with_suffix(suffix).name}"
                          + ("; `dro-grasp export` writes other formats" if suffix == ".parquet" else ""))
    if not several:
        return [check_output(path)]
    if not path.is_dir():
        raise OutputError(f"{path} is no folder; for {len(names)} objects name an existing one (mkdir -p {path})")
    stems = [Path(name).stem for name in names]
    # mug.obj and mug.ply would overwrite each other's results.
    labels = [Path(n).name.replace(".", "_") if stems.count(s) > 1 else s for n, s in zip(names, stems, strict=True)]
    return [check_output(path / f"{label}{suffix}") for label in labels]
