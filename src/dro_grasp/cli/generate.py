"""`dro-grasp generate`: grasps of objects by a hand."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from dro_grasp.cli.given_scene import SceneOptions, check_choice, find_thing
from dro_grasp.cli.inputs import ConstraintOptions, Flag, Mass, ProtocolName, given_forces, optional
from dro_grasp.cli.output import folder_for, print_json, print_table, progress_bar, say, say_aside, say_doubts, say_file
from dro_grasp.cli.remote import generate_at, server_of
from dro_grasp.cli.start import load_libraries
from dro_grasp.cli.switches import in_switches
from dro_grasp.errors import DroGraspError, OptionError
from dro_grasp.extras import require_extra
from dro_grasp.files import check_output, free_name, given_path, make_folder, require_distinct
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, PROTOCOLS

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from dro_grasp.frames import NamedMotion
    from dro_grasp.grasps.batch import GraspBatch
    from dro_grasp.hands.hand import Hand
    from dro_grasp.objects.scenery import FoundObject
    from dro_grasp.objects.shape import ObjectModel
    from dro_grasp.predict.config import GraspRequest
    from dro_grasp.predict.constraints import Constraints
    from dro_grasp.predict.predictor import GraspPredictor, Prediction
    from dro_grasp.predict.problem import GraspProblem

TOGETHER = 64  # Objects of a folder that a GPU predicts together (ours): their distances fill some gigabytes


@dataclass(frozen=True)
class Generate:
    """Predict grasps of an object by a hand, evaluate them in simulation, and save them.

    Example: dro-grasp generate --hand allegro --object mug --output grasps.parquet --picture grasps.png
    """

    hand: str  # A hand's name (see `dro-grasp hands`) or the path of its URDF or MJCF file.
    object: Annotated[str | None, optional("NAME|PATH", "none, with --scene")] = None
    """An object's name (see `dro-grasp objects`), a mesh, a point cloud (PLY, NPY, PCD), or a folder of them."""
    at: Annotated[tuple[float, float, float] | None, optional("X Y Z", "the only thing")] = None
    """Which thing of the scene: the one at this place [m], in the frame of the grasps."""
    seen: SceneOptions = field(default_factory=SceneOptions)
    num: int = 16  # How many grasps of each object.
    candidates: int = 4  # Most candidates for each grasp; the best by score are kept. 1 is quickest.
    seed: int = 0  # The same seed gives the same grasps.
    constraints: ConstraintOptions = field(default_factory=ConstraintOptions)
    """In the object's frame, or in the one that --camera names."""
    table: Annotated[float | None, optional("Z", "no table")] = None
    """Height [m] of a table in the object's frame; the whole hand stays above it. It is there in simulation until the hand has
    closed."""
    touch_table: Annotated[Literal["yes", "no"] | None, optional("yes|no", "beside what lies flat")] = None
    """Whether fingertips may touch the table."""
    obstacles: Annotated[Path | None, optional("MESH|CLOUD", "nothing")] = None
    """Mesh or cloud of what stands around the object, without the object itself, in the same frame and unit. The hand stays
    clear of it, as of all else in --scene: open and 10 cm back, on the straight way from there in pregrasp, in grasp and in
    squeeze."""
    camera: Annotated[Path | None, optional("JSON", "the object's own frame")] = None
    """File with {"frame": "base", "T_frame_camera": 4x4}. The object is then a cloud in the camera's frame, which is cleaned.
    Grasps, --direction and --table are in the named frame. For depth images, with "intrinsics": 3x3."""
    source: str = "auto"
    """What proposes candidates. network: the weights. optimiser: geometry alone, for any hand. auto: the network, and the
    optimiser for grasps that the score does not trust. module:Class: a source of yours. PATH: a grasp file."""
    refine: bool = True  # Refine the candidates on the object's geometry, near where the network proposed them.
    keep_table: Flag = False
    """Keep every point of a cloud. By default a table in it is found and cut off, and hands stay above it."""
    temperature: Annotated[float | None, optional("T", "1; 0.5 for bare clouds")] = None
    """Diversity of the grasps of one placement: 0 takes the likeliest, 1 is as diverse as the training grasps, 2 the most."""
    mass: Mass = None  # Mass of the object [kg], which the grasps shall carry.
    least_confidence: Annotated[float | None, optional("P", "0.2; 0 with --no-refine")] = None
    """Grasps that hold with less probability are not returned; 0 returns all."""
    scale: float = 1.0  # Multiplies the object's coordinates; 0.001 for files in millimetres.
    weights: Annotated[str | None, optional("NAME|PATH", "the shipped weights")] = None
    """Name of shipped weights (see `dro-grasp weights list`) or the path of a weights file."""
    device: str = "cpu"  # Device for the network and the energies: cpu, cuda or cuda:1. Trials always run on the CPU.
    protocol: Annotated[
        ProtocolName | Literal["none"] | None,
        optional(f"{{{','.join(PROTOCOLS)},none}}", f"{DEFAULT_PROTOCOL} for a mesh, none for a bare point cloud"),
    ] = None
    """Trial of each grasp."""
    only_successful: Flag = False
    """Save, draw and view only successful grasps. The success rate still counts all that were asked for."""
    output: Annotated[Path | None, optional("PATH", "not saved")] = None
    """Parquet file for the grasps. With a folder of objects: a folder, for one file an object."""
    picture: Annotated[Path | None, optional("PNG", "no picture")] = None
    """Picture of the best grasps. With a folder of objects: a folder, for one picture an object."""
    view: Flag = False  # Open the viewer on the result.
    json: Flag = False  # Print one JSON object instead of a table.
    server: Annotated[str | None, optional("URL|none", "DRO_GRASP_SERVER, or none")] = None
    """Address of a grasp server (`dro-grasp serve`) that does the work, which saves loading. It knows hands by name."""

    def run(self) -> int:
        """Check everything that can be checked before the work, then do it, or let a server do it."""
        self.check_scene()
        if (address := server_of(self.server)) is not None:
            return generate_at(address, self)

        with progress_bar("loading libraries, hand and weights", self.json):
            names, outputs, pictures, job = self._prepare()
        say_doubts(job.hand.description)
        several = names != [self._source]
        done, failed = [], []
        for part in self._parts(list(zip(names, outputs, pictures, strict=True))):
            for (name, output, picture), made in zip(part, self._predict(job, [name for name, *_ in part]), strict=True):
                try:
                    if isinstance(made, DroGraspError):
                        raise made
                    if isinstance(made, Nothing):
                        if several and output is not None:  # whoever counts success has to know what was asked for in vain
                            made.none.with_asked(self.num).save(output)
                        raise made.error
                    done.append(self._finish(job, made, name, output, picture))
                except DroGraspError as error:
                    if not several:
                        raise
                    say_aside(f"error: {name}: {error}")
                    failed.append({"object": name, "error": str(error)})
        if self.json:
            print_json({"results": [d.report for d in done], "failed": failed} if several else done[0].report)
        if self.view:
            from dro_grasp.apps.viewer.grasp_page import view_grasps

            for d in (d for d in done if len(d.grasps)):
                view_grasps(job.hand, d.obj, d.grasps, d.predicted_points)
        return 2 if failed else 0

    def _prepare(self) -> tuple[list[str], list[Path | None], list[Path | None], Job]:
        """Names of the objects, where their files and pictures go, and what they share; libraries take seconds to load."""
        begin = time.perf_counter()
        load_libraries()
        from dro_grasp.frames import read_motion
        from dro_grasp.hands.library import load_hand
        from dro_grasp.objects.catalogue import resolve_objects
        from dro_grasp.objects.scenery import load_scene
        from dro_grasp.predict.config import GraspRequest
        from dro_grasp.predict.predictor import GraspPredictor

        request = GraspRequest(
            self.num, self.seed, self.candidates, self.refine, self.temperature, self.source, self.least_confidence)
        constraints = self.constraints.constraints(self.table)
        if self.touch_table is not None:
            constraints = replace(constraints, touch_table=self.touch_table == "yes")
        names = [self._source] if self.seen.scene is not None else resolve_objects([self._source])
        several = names != [self._source]
        outputs = paths_per_object(self.output, names, several, ".parquet")
        pictures = paths_per_object(self.picture, names, several, ".png")
        camera = None if self.camera is None else read_motion(self.camera, "T_frame_camera")
        found = None
        if self.seen.scene is not None:
            found = find_thing(load_scene(self.seen.scene, scale=self.scale, camera=self.camera), self)
            constraints = replace(constraints, obstacles=found.obstacles)
        if self.obstacles is not None:
            scene = load_scene(self.obstacles, scale=self.scale)
            scene = scene if camera is None else scene.moved(camera.T.double().numpy())
            constraints = replace(constraints, obstacles=scene.joined(constraints.obstacles))
        start = time.perf_counter() - begin
        hand, predictor = load_hand(self.hand), GraspPredictor(self.weights, self.device)
        seconds = {"start": start, "load": time.perf_counter() - begin - start}
        for folder in {each.parent for each in (*outputs, *pictures) if each is not None}:
            make_folder(folder)
        return names, outputs, pictures, Job(hand, predictor, request, constraints, camera, found, seconds)

    @property
    def _source(self) -> str:
        """What grasps are made of: the object, or the scene in which it is."""
        return str(self.seen.scene) if self.object is None else self.object

    def check_scene(self) -> None:
        """Refuse options that contradict one another or the kind of object, by an OptionError."""
        check_choice(self)
        require_distinct(picture=self.picture, scene_picture=self.seen.scene_picture)
        of_scene = self.seen.scene is not None
        if of_scene and self.keep_table:
            raise OptionError("--keep-table keeps a table that is in an object's own cloud; leave it out: the table of a scene "
                              "is found in any case, and hands stay above it")
        what = "a thing of a scene" if of_scene else "what a camera sees" if self.camera is not None else None
        tried = self.protocol not in {None, "none"}
        asked = [f"--protocol {self.protocol}"] * tried + ["--only-successful"] * self.only_successful
        if what is not None and asked:
            options, verb = " and ".join(asked), "asks" if len(asked) == 1 else "ask"
            seen = " and ".join(["--scene"] * of_scene + ["--camera"] * (self.camera is not None))
            raise OptionError(f"{options} {verb} for a trial in simulation, and {what} is a bare point cloud, which gets none; "
                              f"leave out {options}, or give the object's mesh with --object and leave out {seen}")
        if not self.refine and (idle := given_forces(self.constraints.margin, self.constraints.max_force)):
            raise OptionError(f"{idle} {'say' if ' and ' in idle else 'says'} how hands squeeze once they settle, and with "
                              "--no-refine none does; leave out one of them")
        if self.only_successful and self.protocol == "none":
            raise OptionError("--only-successful saves what passed a trial, and --protocol none asks for none; name a "
                              "--protocol, or leave --only-successful out")
        if self.view and server_of(self.server) is None:
            require_extra("apps")

    def _parts(self, jobs: list[Any]) -> list[list[Any]]:
        """Objects that are predicted together: one by one on the CPU."""
        from dro_grasp.devices import on_accelerator

        size = TOGETHER if on_accelerator(self.device) else 1
        return [jobs[start : start + size] for start in range(0, len(jobs), size)]

    def _predict(self, job: Job, names: list[str]) -> list[Predicted | Nothing | DroGraspError]:
        """What is predicted of each object, or why there is nothing."""
        from dro_grasp.grasps.batch import GraspBatch

        found: list[Any] = []
        for name in names:
            try:
                found.append(self._ready(job, name, next((f.problem for f in found if isinstance(f, Ready)), None)))
            except DroGraspError as error:
                found.append(error)
        ready: list[Ready] = [each for each in found if isinstance(each, Ready)]
        begin = time.perf_counter()
        problems: list[GraspProblem] = [each.problem for each in ready]
        with progress_bar("predicting", self.json) as progress:
            made = iter(job.predictor.run_many(problems, job.request, progress) if problems else [])
        share = (time.perf_counter() - begin) / max(1, len(ready))
        results: list[Predicted | Nothing | DroGraspError] = []
        for each in found:
            if not isinstance(each, Ready):
                results.append(each)
            elif isinstance(own := next(made), DroGraspError):
                results.append(Nothing(GraspBatch.none(job.hand, each.problem.obj), own))
            else:
                results.append(Predicted(each.problem, own, each.seconds, share))
        return results

    def _ready(self, job: Job, name: str, first: GraspProblem | None) -> Ready:
        """An object, read and cut, as a problem beside the first of its part."""
        from dro_grasp.apps.report import doubt, require_trial
        from dro_grasp.predict.problem import GraspProblem

        begin = time.perf_counter()
        with progress_bar(f"reading {Path(name).name}", self.json):
            obj = self._load(name, job.camera) if job.found is None else self._weighed(job.found.obj)
        seconds = time.perf_counter() - begin
        require_trial(obj, self.protocol, self.only_successful)
        for note in obj.notes:
            say_aside(f"{obj.name}: {note}")
        if (warning := doubt(job.constraints, obj, job.camera is not None)) is not None:
            say_aside(in_switches(f"warning: {obj.name}: {warning}"))
        problem = GraspProblem(job.hand, obj, self.device, job.constraints) if first is None else first.beside(obj)
        self._cut(obj)
        return Ready(problem, seconds)

    def _finish(self, job: Job, predicted: Predicted, name: str, output: Path | None, picture: Path | None) -> ObjectResult:
        """Trials, files and report of one object."""
        from dro_grasp.apps.report import protocol_for, told_of
        from dro_grasp.grasps.sources import with_sources

        problem, made, begin = predicted.problem, predicted.made, time.perf_counter()
        obj, seconds = problem.obj, {**job.seconds, "load": job.seconds["load"] + predicted.load}
        if made.shortage is not None:
            say_aside(f"warning: {obj.name}: {made.shortage}")
        middle = time.perf_counter()
        grasps = self._evaluate(problem, made.grasps)
        seconds |= {**made.seconds, "trial": time.perf_counter() - middle if bool(grasps.evaluated.any()) else 0.0}
        told = told_of(
            obj, made, grasps, hand=job.hand.name, num=self.num, seed=self.seed, weights=job.predictor.weights_name,
            protocol=protocol_for(obj, self.protocol), frame="object" if job.camera is None else job.camera.frame)
        told.report["output"] = None if output is None else str(output)
        middle = time.perf_counter()
        kept, points = grasps, made.points
        if self.only_successful:
            kept, points = grasps[grasps.success], points[grasps.success]
        if not len(kept):
            self.say_that_none_is_left(obj.name, output, picture)
        if output is not None:
            taken = None if job.found is None else obj  # of a scene's file alone it cannot be loaded again
            with_sources(kept, self.hand, name, self.scale, job.camera, taken).save(output)
        if picture is not None and len(kept):
            from dro_grasp.pictures.sheets import draw_grasps

            told.report["picture"] = str(picture)
            draw_grasps(job.hand, obj, kept, picture)
        total = sum(job.seconds.values()) + predicted.load + predicted.share + time.perf_counter() - begin
        seconds |= {"files": time.perf_counter() - middle, "total": total}
        told.report["seconds"] |= {k: round(v, 4) for k, v in seconds.items()}
        if not self.json:
            self.show(*told)
        return ObjectResult(told.report, obj, kept, points)

    def _cut(self, obj: ObjectModel) -> None:
        """Cut a mesh into convex parts, which may take most of a minute the first time; says what comes of it."""
        if obj.is_cloud:
            return
        said = set(obj.notes)
        with progress_bar(f"cutting {obj.name} into convex parts, at most [s]", self.json) as progress:
            obj.cut(progress)
        for note in obj.notes:
            if note not in said:
                say_aside(f"{obj.name}: {note}")

    def say_that_none_is_left(self, name: str, output: Path | None, picture: Path | None) -> None:
        """Say what comes of it that no grasp succeeded, of all that was asked for."""
        for asked, outcome in ((output, f"{output} holds none"), (picture, f"{picture} is not drawn"),
                               (self.view, "there is none to view")):
            if asked:
                say_aside(f"warning: {name}: no grasp succeeded, so {outcome}")

    def _load(self, name: str, camera: NamedMotion | None) -> ObjectModel:
        from dro_grasp.objects.catalogue import load_object

        if camera is None:
            return load_object(name, scale=self.scale, keep_table=self.keep_table, mass=self.mass)
        from dro_grasp.objects.perception.scan import load_scan  # with the completion of clouds

        return self._weighed(load_scan(given_path(name), camera.T.double().numpy(), self.scale, self.keep_table, self.table))

    def _weighed(self, obj: ObjectModel) -> ObjectModel:
        """The object with the mass that was stated, if any."""
        from dro_grasp.objects.shape import with_mass

        return obj if self.mass is None else with_mass(obj, self.mass)

    def _evaluate(self, problem: GraspProblem, grasps: GraspBatch) -> GraspBatch:
        from dro_grasp.apps.report import NO_TRIAL, protocol_for
        from dro_grasp.predict.stages import evaluate

        protocol = protocol_for(problem.obj, self.protocol)
        if protocol == NO_TRIAL:
            return grasps
        with progress_bar("evaluating", self.json) as progress:
            return evaluate(problem, grasps, protocol, progress)

    def show(self, report: dict[str, Any], rows: list[list[Any]], lines: list[str]) -> None:
        """Print the table, and what is told under it."""
        columns = ["grasp", "origin", "confidence", "carries [kg]", "squeeze [N]", "success", "contacts", "penetration [mm]",
                   "reason"]
        print_table(f"{report['hand']} on {report['object']}", columns, rows)
        say("  ".join(f"{k} {v:.2f} s" for k, v in report["seconds"].items()))
        for line in lines:
            say(line)
        for what, key in (("grasps", "output"), ("picture", "picture")):
            if report.get(key):
                say_file(what, report[key])


class Ready(NamedTuple):
    """An object that was read."""

    problem: GraspProblem
    seconds: float  # that reading took [s]


class Predicted(NamedTuple):
    """What was predicted of an object."""

    problem: GraspProblem
    made: Prediction
    load: float  # time of reading it [s]
    share: float  # and of predicting, of those that were predicted together an equal share [s]


class Nothing(NamedTuple):
    """An object for which there is no grasp."""

    none: GraspBatch
    error: DroGraspError  # which says why


@dataclass(frozen=True)
class Job:
    """What all objects of one call share."""

    hand: Hand
    predictor: GraspPredictor
    request: GraspRequest
    constraints: Constraints
    camera: NamedMotion | None
    found: FoundObject | None  # the object, out of a scene
    seconds: dict[str, float]  # Time to start, most of which goes to loading libraries, and to load hand and weights [s].


@dataclass(frozen=True)
class ObjectResult:
    """The grasps of one object."""

    report: dict[str, Any]  # The JSON object.
    obj: ObjectModel
    grasps: GraspBatch  # The grasps that were kept.
    predicted_points: Float[Tensor, "n n_points 3"]  # Their hand points as the network placed them [m].


def paths_per_object(path: Path | None, names: list[str], several: bool, suffix: str) -> list[Path | None]:
    """Where each object's file goes, checked before the work: the path itself, or files in the folder that it names."""
    if path is None:
        return [None] * len(names)
    if not several:
        return [check_output(path, suffix)]
    path = folder_for(path, suffix, len(names))
    stems = [Path(name).stem for name in names]
    # mug.obj and mug.ply would overwrite each other's results.
    labels = list[str]()
    for name, stem in zip(names, stems, strict=True):
        own = Path(name).name.replace(".", "_") if stems.count(stem) > 1 else stem
        labels.append(free_name(own, labels))
    files = (path / f"{label}{suffix}" for label in labels)
    return [check_output(file) if path.is_dir() else file for file in files]
