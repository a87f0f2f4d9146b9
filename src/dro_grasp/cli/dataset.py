"""`dro-grasp synthesize` and `dataset`: a grasp data set for any hand, what is done with data sets, and those of others."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dro_grasp.cli.inputs import Flag, ProtocolName, optional
from dro_grasp.cli.output import print_result, progress_bar, records, say_aside, say_doubts
from dro_grasp.errors import GraspFileError, HandError, OptionError
from dro_grasp.files import check_folder, check_output, make_folder
from dro_grasp.kinds import require_positive
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, PROTOCOLS

if TYPE_CHECKING:
    from dro_grasp.training.data.collections.collection import PairGrasps
    from dro_grasp.training.data.engine.pools import Pool
    from dro_grasp.training.data.engine.worker import Job


@dataclass(frozen=True)
class Synthesize:
    """Synthesize grasps from geometry alone, and keep those that pass a trial. A rerun resumes.

    Example: dro-grasp synthesize --hand my_hand.urdf --object bottle can --grasps 50 --output my_data
    """

    hand: tuple[str, ...]  # Names or paths of hands.
    object: tuple[str, ...]  # Names, meshes, folders of meshes, or groups such as builtin:train and assets:validate.
    output: Path  # Folder for the grasp files; created if missing.
    grasps: int = 150  # Valid grasps of each hand on each object. A rerun with a larger number adds the difference.
    minutes: Annotated[float | None, optional("MINUTES", "no limit")] = None
    """Start no new work after this time [min]. A rerun resumes."""
    workers: int = 2  # Processes of one thread each. A running Ray cluster uses all its CPUs instead.
    shard: Annotated[str, tyro.conf.arg(metavar="I/N", help_behavior_hint="(default: 1/1, all of them)")] = "1/1"
    """Part of the pairs that this run fills: 3/16 is the third of sixteen. All parts may run at once and share the folder, as
    in an array job."""
    engine: Literal["local", "ray"] = "local"  # Processes on this machine, or a Ray cluster.
    ray_address: Annotated[str | None, optional("HOST:PORT", "RAY_ADDRESS, or a new local cluster")] = None
    """Head of the Ray cluster, or `auto` for the cluster running on this machine."""
    device: str = "cpu"  # Device: cpu, cuda or cuda:1. What passes there is judged again by the CPU.
    confirm: float = 1.0
    """Share of what passes on a device that the CPU judges again; if it refutes more than a tenth, it judges all."""
    scale: float = 1.0  # Factor for the coordinates of the objects: 0.001 for millimetres.
    seed: int = 0  # The same seed gives the same grasps.
    protocol: ProtocolName = DEFAULT_PROTOCOL  # Protocol of the trial that grasps must pass.
    also: tuple[ProtocolName, ...] = ()  # Further protocols that they must pass, such as robust.
    resettle: Flag = False  # Settle as `generate` does, so that hands squeeze for the object's weight.
    idle: float = 0.6
    """Probability, 0 to 1, that a finger other than the thumb need not touch. Lower values give fuller grasps, and fewer."""
    keep_idle_fingers: Flag = False
    """Leave idle fingers as they are. By default they close onto the object where the grasp still passes."""
    json: Flag = False  # Print one JSON object instead of a table.

    def run(self) -> int:
        """Check numbers and names, then fill the folder; the exit code is 2 if every pair fails and there is no grasp."""
        from dro_grasp.hands.library import load_hand_description
        from dro_grasp.objects.catalogue import resolve_objects
        from dro_grasp.optimize.contacts import ContactConfig
        from dro_grasp.optimize.synthesis import SynthesisConfig
        from dro_grasp.training.data.engine.schedule import require_distinct_names, require_known, synthesize_dataset
        from dro_grasp.training.data.engine.worker import EngineConfig

        self._check_numbers()
        objects = resolve_objects(list(self.object))
        require_known(self.hand, objects)
        require_distinct_names(self.hand, objects)
        for name in self.hand:
            with suppress(HandError):  # told with its pairs
                say_doubts(load_hand_description(name)[0])
        config = EngineConfig(
            self.protocol, self.scale, None if self.minutes is None else 60 * self.minutes, shard=self._part(),
            also=self.also, resettle=self.resettle, close_fingers=not self.keep_idle_fingers, confirm=self.confirm,
            synthesis=SynthesisConfig(device=self.device, contacts=ContactConfig(idle=self.idle))).suited()
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
        require_positive(grasps=self.grasps, workers=self.workers)
        if self.minutes is not None and not (math.isfinite(self.minutes) and self.minutes > 0):
            raise OptionError(f"--minutes is {self.minutes}; give a positive number, or leave it out for no limit")
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise OptionError(f"--scale is {self.scale}; give a positive number, for example 0.001 for millimetres")
        if not 0 < self.confirm <= 1:
            raise OptionError(f"--confirm is {self.confirm}; give a share above 0 and up to 1, which judges all")
        if self.confirm != 1 and self.device == "cpu":
            raise OptionError(f"--confirm is {self.confirm:g}, of what passes on another device; name it with --device, or "
                              "leave out --confirm")
        if self.ray_address is not None and self.engine != "ray":
            raise OptionError("--ray-address is that of a Ray cluster; add --engine ray, or leave it out")
        if not 0 <= self.idle <= 1:
            raise OptionError(f"--idle is {self.idle}; give a probability, from 0 (every finger holds) to 1")

    def _part(self) -> tuple[int, int]:
        found = re.fullmatch(r"(\d+)/(\d+)", self.shard)
        if found is None:
            raise OptionError(f"--shard is '{self.shard}'; give a part from 1 on, and of how many, such as 3/16")
        return int(found[1]), int(found[2])

    def _ray_pool(self, job: Job) -> Pool:
        from dro_grasp.training.data.engine.pools import RayPool

        return RayPool(job, self.workers, job.config.limit, self.ray_address)


@dataclass(frozen=True)
class Import:
    """Convert grasps of other data sets into grasp files, to evaluate, filter and train on.

    Example: dro-grasp dataset import cmap_dataset.pt --format cmap --hands barrett=assets/barrett_multidex --output imported
    """

    inputs: tyro.conf.Positional[tuple[Path, ...]]
    """`cmap_dataset.pt` of the official D(R,O) release, or npy files of DexGraspNet or DexGraspBench."""
    format: Literal["cmap", "dexgraspnet", "dexgraspbench"]  # Format of the files.
    output: Path  # Folder for one grasp file per hand; created if missing.
    hands: tuple[str, ...] = ()
    """Names or paths of the hands. NAME_IN_FILE=NAME renames one. A file that names no hand needs exactly one."""
    object: Annotated[str | None, optional("NAME|PATH", "the file's")] = None
    """Object of all grasps, if the file names another or none."""
    json: Flag = False  # Print one JSON object instead of a table.

    def run(self) -> int:
        """Read all files, find hands and objects, write grasp files."""
        from dro_grasp.training.data.collections.importing import import_grasps
        from dro_grasp.training.data.collections.merging import file_name

        check_folder(self.output)
        if len(plain := [name for name in self.hands if "=" not in name]) > 1:
            raise OptionError(f"--hands names {' and '.join(plain)} for all hands of the files; name one, or say which is "
                              "which (NAME_IN_FILE=NAME)")
        here = {theirs: ours for theirs, _, ours in (pair.rpartition("=") for pair in self.hands)}
        by_hand, missing = import_grasps(self.inputs, self.format, here, self.object)
        for obj, why in missing.items():
            say_aside(f"grasps of {obj} are left out: {why}")
        if not (by_hand or self.json):
            raise GraspFileError(
                "no grasp was imported; name the object of all grasps with --object, or set DRO_GRASP_ASSETS to the folder "
                "with the data set's objects" if missing else
                f"no grasp was imported: {', '.join(map(str, self.inputs))} holds none; name other files")
        folder = make_folder(self.output) if by_hand else self.output
        rows = []
        for grasps in by_hand.values():
            path = folder / file_name(grasps.hand)
            grasps.save(path)
            rows.append([grasps.hand, len(set(grasps.object)), len(grasps), str(path)])
        columns = ["hand", "objects", "grasps", "file"]
        print_result(self.json, {"files": records(columns, rows), "missing": missing}, "imported", columns, rows,
                     "`dro-grasp dataset filter` keeps those that pass a trial")
        return 0 if rows else 2


@dataclass(frozen=True)
class Info:
    """Count the grasps of a data set by hand and object."""

    folder: tyro.conf.Positional[Path]  # An output folder of `dro-grasp synthesize`, a folder of grasp files, or a grasp file.
    json: Flag = False  # Print one JSON object instead of a table.

    def run(self) -> int:
        """Count."""
        from dro_grasp.training.data.collections.collection import count_collection

        counts = count_collection(self.folder)
        total = sum(sum(c.values()) for c in counts.values())
        rows = [[hand, len(c), sum(c.values()), min(c.values())] for hand, c in counts.items()]
        print_result(self.json, {"total": total, "hands": counts}, f"data set {self.folder}",
                     ["hand", "objects", "grasps", "fewest"], rows, f"{total} grasps in all")
        return 0


@dataclass(frozen=True)
class DataSets:
    """The data sets that a command takes."""

    inputs: tyro.conf.Positional[tuple[Path, ...]]
    """Output folders of `dro-grasp synthesize`, folders of grasp files, or grasp files."""

    def given(self, output: Path | None = None) -> tuple[Path, ...]:
        """The data sets; refuses none at all, and a folder to write into that holds one."""
        from dro_grasp.training.data.collections.collection import require_apart

        if not self.inputs:
            raise OptionError("no data set was given; name a folder or a grasp file at least")
        if output is not None:
            require_apart(self.inputs, output)
        return self.inputs

    def pairs(self, only_successful: bool, output: Path | None = None) -> Iterator[PairGrasps]:
        """The grasps of each pair in them; refuses two hands of one name, which cannot join in one file or table."""
        from dro_grasp.training.data.collections.collection import read_collection
        from dro_grasp.training.data.collections.coverage import of_one_version

        given = self.given(output)
        return of_one_version((path, pair) for path in given for pair in read_collection(path, only_successful))


@dataclass(frozen=True)
class Report(DataSets):
    """Report yields, failures and diversity of a data set: palm directions, wrist rolls, grasp sizes, joints.

    Example: dro-grasp dataset report my_data --output report.html
    """

    output: Annotated[Path | None, optional("PATH", "no page")] = None  # Self-contained HTML page with charts and pictures.
    json: Flag = False  # Print one JSON object instead of a table.

    def run(self) -> int:
        """Measure, print, write the page."""
        from dro_grasp.training.data.collections.coverage import measure_coverage
        from dro_grasp.training.data.collections.report import write_report

        output = None if self.output is None else check_output(self.output, ".html")
        hands = measure_coverage(self.pairs(only_successful=True))
        if output is not None:
            with progress_bar("drawing", self.json) as progress:
                write_report(hands, output, progress)
        rows = [[h.grasps.hand, len(h.grasps), len(h.pairs), h.yields.per_cpu_hour, *h.diversity.values()] for h in hands]
        values = {"hands": [h.to_dict() for h in hands], "output": None if output is None else str(output)}
        columns = ["hand", "grasps", "objects", "per CPU-hour", "diversity", "of wrist", "of joints"]
        print_result(self.json, values, "data set", columns, rows, "" if output is None else f"page: {output}")
        for h in hands:
            for pair in h.pairs:
                if not (pair.grasps or self.json):
                    say_aside(f"{h.grasps.hand} on {pair.object}: no grasp, {pair.reason}")
        return 0


@dataclass(frozen=True)
class Merge(DataSets):
    """Merge data sets into one file per hand, or several of about 100 MB, without near-duplicates and failed grasps.

    Example: dro-grasp dataset merge my_data more --output grasps --per-pair 150
    """

    output: Path  # Folder for the files; created if missing. It holds temporary files, as large as the inputs, until the end.
    per_pair: Annotated[int | None, optional("N", "all")] = None
    """Limit of grasps of a hand on an object; those that cover palm directions best are kept."""
    json: Flag = False  # Print one JSON object instead of a table.

    def run(self) -> int:
        """Merge, and write the files."""
        from dro_grasp.training.data.collections.merging import (
            ASIDE,
            file_name,
            merge,
            remove_further,
            require_choice,
            require_no_shards,
        )
        from dro_grasp.training.data.engine.shards import sole_run

        require_choice(self.per_pair)
        given = self.given(self.output)
        require_no_shards(self.output)
        folder = make_folder(self.output)
        rows, last = [], {}
        with sole_run(folder):
            for left in folder.glob(f"{ASIDE}*"):  # by a run that was killed
                rmtree(left, ignore_errors=True)
            for merged in merge(given, self.per_pair, folder):
                path = folder / file_name(merged.hand, merged.number)
                merged.save(path)
                last[merged.hand] = merged.number
                rows.append([merged.hand, len(merged), merged.duplicates, merged.surplus, path.stat().st_size, path.name])
            for hand, number in last.items():
                remove_further(folder, hand, number)
        columns = ["hand", "grasps", "duplicates", "surplus", "bytes", "file"]
        values, total = {"output": str(folder), "files": records(columns, rows)}, sum(row[1] for row in rows)
        print_result(self.json, values, f"merged into {folder}", columns, rows, f"{total} grasps in all")
        if not total:
            say_aside("no grasp held in a trial; `dro-grasp evaluate` tests grasps that had none")
        return 0


@dataclass(frozen=True)
class Check(DataSets):
    """Evaluate a random sample of a data set again, and compare the results with the stored ones.

    Example: dro-grasp dataset check my_data --sample 500
    """

    sample: int = 100  # Grasps to evaluate, drawn uniformly from all grasps.
    protocol: Annotated[ProtocolName | None, optional(f"{{{','.join(PROTOCOLS)}}}", "the stored one")] = None
    """Protocol of the trial."""
    friction: Annotated[float | None, optional("MU", "the protocol's")] = None  # Friction coefficient between hand and object.
    mass_factor: float = 1.0  # Factor for the masses of the objects, and thereby for the forces.
    seed: int = 0  # Seed of the sample.
    json: Flag = False  # Print one JSON object instead of a table.

    def run(self) -> int:
        """Draw, evaluate, compare."""
        from dro_grasp.compare.metrics import wilson_interval
        from dro_grasp.simulation.protocols import changed
        from dro_grasp.training.data.collections.checking import check, stored_protocol

        pairs = list(self.pairs(only_successful=False))
        rules = changed(self.protocol or stored_protocol(pairs), friction=self.friction, mass_factor=self.mass_factor)
        with progress_bar("evaluating", self.json) as progress:
            found = check(pairs, self.sample, rules, self.seed, progress)
        low, high = wilson_interval(found.agreed, found.evaluated)
        rows = [[hand, n, success, success / n] for hand, (n, success) in found.hands.items()]
        values = {
            "protocol": found.protocol, "evaluated": found.evaluated, "agreed": found.agreed, "agreement": found.share,
            "interval_95": [low, high], "succeeded": found.succeeded, "hands": found.hands,
            "reasons": dict(found.reasons.most_common())}
        notes = [f"{found.agreed} of {found.evaluated} results agree with the stored ones: {found.share:.1%} "
                 f"(95 %: {low:.1%} to {high:.1%})"]
        notes += [f"  {count} stored as successful now fail: {reason}" for reason, count in found.reasons.most_common(5)]
        columns = ["hand", "grasps", "success", "rate"]
        print_result(self.json, values, f"evaluated again, protocol {found.protocol}", columns, rows, *notes)
        return 0


@dataclass(frozen=True)
class Filter(DataSets):
    """Evaluate all grasps of a data set, and keep those that pass. A rerun resumes.

    Example: dro-grasp dataset filter theirs.parquet --also robust --output kept
    """

    output: Path  # Folder for the files, one per hand at the end; created if missing. Each pair has a file in it as it is done.
    protocol: ProtocolName = DEFAULT_PROTOCOL  # Protocol of the trial.
    also: tuple[ProtocolName, ...] = ()  # Further protocols that grasps must pass.
    friction: Annotated[float | None, optional("MU", "the protocol's")] = None  # Friction coefficient between hand and object.
    resettle: Flag = False  # Settle as `generate` does before, so that hands squeeze for the object's weight.
    again: Flag = False  # With --resettle: refine those that fail, settle them once more, keep what then passes.
    close_fingers: Flag = False  # Close idle fingers onto the object where the grasp still passes.
    workers: int = 1  # Processes of one thread each. 1 uses all cores in the trials alone.
    json: Flag = False  # Print one JSON object instead of a table.

    def run(self) -> int:
        """Evaluate, and write one file per hand; the exit code is 2 if no pair could be filtered."""
        from dro_grasp.simulation.protocols import changed
        from dro_grasp.training.data.collections.filtering import FilterConfig, filter_dataset

        rules = tuple(changed(name, friction=self.friction) for name in dict.fromkeys((self.protocol, *self.also)))
        config = FilterConfig(rules, self.resettle, self.again, self.close_fingers)
        with progress_bar("evaluating", self.json) as progress:
            report = filter_dataset(
                self.pairs(only_successful=False, output=self.output), self.output, config, self.workers, progress, say_aside)
        columns, total = ["hand", "object", "grasps", "kept"], sum(kept.grasps for kept in report.pairs)
        rows, passed = [[k.hand, k.object, k.grasps, k.kept] for k in report.pairs], sum(kept.kept for kept in report.pairs)
        label = ", ".join(each.label for each in rules)
        reasons = sum((Counter(kept.failures) for kept in report.pairs), Counter[str]())
        failures = [{"hand": h, "object": o, "reason": why} for (h, o), why in report.given_up.items()]
        values = {
            "output": str(self.output), "protocol": label, "grasps": total, "kept": passed,
            "remade": sum(kept.remade for kept in report.pairs), "reasons": dict(reasons.most_common()),
            "pairs": records(columns, rows), "failures": failures}
        notes = [f"  {count} left out: {reason}" for reason, count in reasons.most_common()]
        print_result(self.json, values, f"protocol {label}", columns, rows,
                     f"{passed} of {total} kept, in {self.output}", *notes)
        for failure in failures:
            say_aside(f"{failure['hand']} on {failure['object']}: {failure['reason']}")
        return 2 if failures and not report.pairs else 0


@dataclass(frozen=True)
class BundleCommand(DataSets):
    """Pack grasps, hands and object clouds into one portable file for training.

    Example: dro-grasp dataset bundle my_data --output bundle.safetensors
    """

    output: Path  # Bundle to write (.safetensors).
    split: Literal["train", "few_shot", "validate"] = "train"
    """Grasps to include. train: for training. few_shot: of held-out hands, for fine-tuning. validate: on held-out objects,
    for measuring."""
    hands: tuple[str, ...] = ()  # Hands to include; by default all.
    per_pair: Annotated[int | None, optional("N", "all")] = None
    """Limit of grasps of a hand on an object; those that cover palm directions best are kept."""
    hands_without_grasps: tuple[str, ...] = ()
    """Names or URDF files of further hands, such as those of `hand make`. `pretrain` uses their kinematics."""
    json: Flag = False  # Print one JSON object instead of a table.

    def run(self) -> int:
        """Select the grasps of the split, find their hands and objects, write the bundle."""
        from dro_grasp.hands.library import load_hand
        from dro_grasp.training.data.collections.bundling import make_bundle

        output = check_output(self.output, ".safetensors")
        further = [load_hand(name) for name in self.hands_without_grasps]
        bundle, left_out = make_bundle(self.given(), output, self.split, self.hands, self.per_pair, further)
        if left_out:
            say_aside(f"{left_out} grasps outside split '{self.split}' are left out")
        report = {"output": str(output), "bytes": output.stat().st_size, **bundle.summary()}
        print_result(self.json, report, f"bundle {output}", ["hand", "grasps"], [*report["hands"].items()],
                     f"{report['objects']} objects, {report['grasps']} grasps, {report['bytes'] / 1e6:.1f} MB")
        return 0


@dataclass(frozen=True)
class Dataset:
    """Inspect, merge, check, filter, import and bundle grasp data sets."""

    command: (
        Annotated[Info, tyro.conf.subcommand("info")]
        | Annotated[Import, tyro.conf.subcommand("import")]
        | Annotated[Report, tyro.conf.subcommand("report")]
        | Annotated[Merge, tyro.conf.subcommand("merge")]
        | Annotated[Check, tyro.conf.subcommand("check")]
        | Annotated[Filter, tyro.conf.subcommand("filter")]
        | Annotated[BundleCommand, tyro.conf.subcommand("bundle")]
    )
