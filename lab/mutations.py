"""Faults planted in the package, one at a time, and whether `make test` finds them.

    python -m lab.mutations [--only N ...] [--json]

Each fault is one change at one place, of a kind that people make. It is planted in a temporary copy of the tracked files; the
checkout stays as it is. Tests run in one process and stop at the first that fails: those of the mirrored folder first, then
the files that import the module. The faults that are left are then planted together, all other tests run once, and each fault
is planted alone for those that fail; a test that passes only because of two faults would be overlooked. tests/golden comes
last, so that a fault which golden alone finds is told apart. The test that found a fault must pass on a copy without it.

Results are kept in out/mutations.json: a rerun does what is missing, and what `--only` names. Copies begin with the user's
cache of derived geometry, which no fault here would change.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dro_grasp.files import replacing
from dro_grasp.geometry.cache import cache_folder

ROOT = Path(__file__).parents[1]
"""The checkout."""
RESULTS = ROOT / "out" / "mutations.json"
"""What was found so far."""
LONGEST = 3600.0
"""Time after which tests are given up [s] (ours)."""
GOLDEN = "tests/golden/"
"""Tests that compare results bitwise with recorded ones: they find that something changed, not that it is wrong."""
PLANTED = "DRO_GRASP_PLANTED"
"""Variable of tests that run in a copy with a fault."""
STAGES = ("mirrored", "importing", "others", "golden")
"""Groups of test files, in the order in which they run."""


@dataclass(frozen=True)
class Fault:
    """One change of one file."""

    path: str
    """Within src/dro_grasp."""
    text: str
    """What stands there, once in the file."""
    planted: str
    """What is put in its place."""
    breaks: str
    """What is wrong then."""

    @property
    def module(self) -> str:
        """Dotted name of the module."""
        return "dro_grasp." + self.path.removesuffix(".py").replace("/", ".")

    def plant(self, folder: Path) -> None:
        """Change the file in a copy of the checkout; ValueError: the text is not there, or not once."""
        file = folder / "src" / "dro_grasp" / self.path
        content = file.read_text()
        if (count := content.count(self.text)) != 1:
            raise ValueError(f"{self.path} has {self.text!r} {count} times; expected once: adapt the table of faults")
        file.write_text(content.replace(self.text, self.planted))


FAULTS = (
    Fault("geometry/distance_field.py", "+ 0.5 * (turned * offset).sum(-1)", "+ (turned * offset).sum(-1)",
          "second-order term of a signed distance without its factor 0.5"),
    Fault("geometry/table_plane.py", "plane[3] + normal @ T[:3, 3]", "plane[3] - normal @ T[:3, 3]",
          "sign of the shift of a table's height between frames"),
    Fault("hands/description/tree_reading.py", "factor *= step.multiplier", "factor = step.multiplier",
          "ratio of a mimic joint that follows another mimic joint"),
    Fault("hands/description/tree_reading.py", "ends = sorted((model.jnt_range[joint] - offset[joint]) / c)",
          "ends = sorted(model.jnt_range[joint] / c)", "offset of a follower ignored in the limits of its leader"),
    Fault("hands/description/loader.py", "(path, *(within[name] for name in sorted(within)))", "(path,)",
          "hash of a hand without its meshes: a stale key"),
    Fault("hands/kinematics/joint_solver.py", "return state.T @ local, state.q", "return local @ state.T, state.q",
          "step of the wrist in the world's frame instead of its own"),
    Fault("objects/shape.py", "mass, *solid)", "mass)", "cached scenes do not know an object's convex parts: a stale key"),
    Fault("objects/perception/scan.py", "normals @ R.T\n", "normals @ R\n",
          "normals of a scan turned the wrong way into the wanted frame"),
    Fault("objects/perception/partial_views.py", "camera.noise * (hits.depth / 0.5) ** 2", "camera.noise * (hits.depth / 0.5)",
          "noise of a depth camera grows with depth, not with its square"),
    Fault("network/checkpoints.py", "if digest != shipped:", 'if shipped == "none":', "hash of shipped weights unchecked"),
    Fault("network/latent.py", "middle = z + 0.5 * length *", "middle = z + length *",
          "midpoint rule of the flow without its 0.5"),
    Fault("network/network.py", "query @ key.mT / query.shape[-1] ** 0.5", "query @ key.mT / x.shape[-1] ** 0.5",
          "attention in training scaled by the whole width instead of a head's"),
    Fault("distance_matrix.py", "better = error_read < error_given", "better = error_read > error_given",
          "the joint solver starts from the worse of two guesses"),
    Fault("grasps/export/writers.py", "frame.T_frame_object.double() @ camera.double()",
          "camera.double() @ frame.T_frame_object.double()", "swapped frames in the object's pose of an exported file"),
    Fault("grasps/export/writers.py", '"post_place_retreat": _path(at_wrist, -palm, RETREAT)',
          '"post_place_retreat": _path(at_wrist, palm, RETREAT)', "sign of the retreat after placing: into the object"),
    Fault("optimize/terms.py", "2 * force[..., None, :] + torch.linalg.cross(arm.expand_as(points), points, dim=-1)",
          "(2 * force[..., None, :]).expand_as(normals)", "force closure's gradient without the torque's term"),
    Fault("optimize/grasp_energy.py", "energies.penetration(distance - radii - self.clear, gradient)",
          "energies.penetration(distance - radii, gradient)", "clearance to table and obstacles ignored in the energy"),
    Fault("optimize/squeeze.py", "tree.joint_unit**2 / config.stiffness", "tree.joint_unit / config.stiffness",
          "unit of the squeeze of sliding joints"),
    Fault("optimize/synthesis.py", "torch.Generator().manual_seed(seed)", "torch.Generator().manual_seed(0)",
          "seed of synthesis ignored"),
    Fault("simulation/rollout.py", "newtons * (self.start.rotation[rows] @ axis)", "newtons * axis",
          "disturbing forces along axes of the wrist's frame instead of the object's"),
    Fault("simulation/rollout.py", '("actuator_gainprm", "actuator_biasprm"):', '("actuator_gainprm",):',
          "perturbed servos change their gain without their feedback"),
    Fault("simulation/outcome.py", "counted = slice(None) if rules.reset else slice(-1, None)", "counted = slice(-1, None)",
          "a protocol with a reset judges the last force alone"),
    Fault("predict/settling.py", "stable = settled.stable & ~wrong", "stable = settled.stable",
          "a grasp that ends where constraints forbid keeps its score"),
    Fault("predict/admission.py", "(enough & ~(beside & (distance < config.touch)).any(-1)).cpu()", "enough.cpu()",
          "touch beside the contact region ignored"),
    Fault("predict/score/features.py", "arriving=near.points - before", "arriving=before - near.points",
          "sign of a feature of the score"),
    Fault("files.py", "os.replace(temporary, place)", "path.write_bytes(temporary.read_bytes())",
          "a file is written in place instead of replaced at once"),
    Fault("compare/metrics.py", "q - p - math.hypot(q - q_low, p_high - p)", "q - p - math.hypot(q - q_low, p - p_low)",
          "Newcombe's interval takes the wrong end of Wilson's"),
    Fault("compare/rows.py", "{label: success_rate(k, asked) for label, k in numbers.items()}",
          "{label: success_rate(k, len(success[0])) for label, k in numbers.items()}",
          "rates of what was returned rather than of what was asked for"),
    Fault("training/runs.py", "(self.schedule.seed * 1_000_003 + step) * 1_009 + shard",
          "(self.schedule.seed * 1_000_003 + step) * 1_009", "all shards of a step draw the same samples"),
    Fault("training/data/engine/schedule.py", "[shard[0] - 1 :: shard[1]]", "[shard[0] :: shard[1]]",
          "the first pair of a data set that several machines make belongs to none"),
)
"""The faults, chosen before anyone looked whether tests find them; none may be exchanged for one that is found."""


def tracked(root: Path = ROOT) -> list[str]:
    """Files of the checkout that git knows, as they are there now."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, text=True, check=True).stdout
    return [name for name in listed.split("\0") if name and (root / name).is_file()]


@contextmanager
def copy() -> Iterator[Path]:
    """A temporary copy of the tracked files, with a repository and a cache of its own."""
    with tempfile.TemporaryDirectory(prefix="mutations-") as name:
        folder = Path(name) / "checkout"
        for file in tracked():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / file, folder / file)
        git = ["git", "-C", str(folder), "-c", "user.name=lab", "-c", "user.email=lab@localhost"]
        for words in (["init", "-q"], ["add", "-A"], ["commit", "-q", "-m", "A copy"]):
            subprocess.run([*git, *words], check=True)
        if cache_folder().is_dir():
            shutil.copytree(cache_folder(), Path(name) / "cache")
        yield folder


def run_tests(folder: Path, tests: Sequence[str], *options: str) -> tuple[str, ...]:
    """Tests that fail of some files or single tests of a copy, run in this order, as `make test` does, but in one process."""
    report = folder.parent / "report.xml"
    report.unlink(missing_ok=True)
    words = [sys.executable, "-m", "pytest", "-q", "--no-header", "--tb=no", "-p", "no:cacheprovider", "-o",
             "junit_family=xunit1", "--junitxml", str(report), "--basetemp", str(folder.parent / "temporary"), *options, *tests]
    here = {"PYTHONPATH": str(folder / "src"), "DRO_GRASP_CACHE": str(folder.parent / "cache"), "OMP_NUM_THREADS": "1",
            PLANTED: "1"}
    try:
        done = subprocess.run(words, cwd=folder, env=os.environ | here, capture_output=True, text=True, timeout=LONGEST,
                              check=False)
    except subprocess.TimeoutExpired as error:
        raise RuntimeError(f"tests took longer than {LONGEST:.0f} s: {' '.join(tests[:3])} ...") from error
    if done.returncode not in (0, 1, 2, 5) or not report.is_file():  # 5: every test was deselected
        raise RuntimeError(f"pytest ended with {done.returncode}:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
    return tuple(failures(report))


def failures(report: Path) -> Iterator[str]:
    """Tests that failed, and modules that could not be imported, in a report of pytest."""
    for case in ET.parse(report).iter("testcase"):
        if case.find("failure") is not None or case.find("error") is not None:
            file, name = case.get("file"), case.get("name", "")
            yield f"{file}::{name}" if file else name.replace(".", "/") + ".py"


def near(fault: Fault, files: Mapping[str, str]) -> list[list[str]]:
    """Of test files, given with their text, those of the mirrored folder, and the others that import the module."""
    name, (parent, _, last) = Path(fault.path).stem, fault.module.rpartition(".")
    folder = Path("tests") / Path(fault.path).parent
    while folder != Path("tests") and not any(Path(file).is_relative_to(folder) for file in files):
        folder = folder.parent
    imports = (fault.module + " ", fault.module + "\n", f"from {parent} import {last}")
    mirrored, importing = [], []
    for file, text in sorted(files.items(), key=lambda pair: (Path(pair[0]).name != f"test_{name}.py", pair[0])):
        if Path(file).is_relative_to(folder) if folder != Path("tests") else Path(file).name == f"test_{name}.py":
            mirrored.append(file)
        elif any(words in text for words in imports):
            importing.append(file)
    return [mirrored, importing]


def run_with(faults: Sequence[Fault], tests: Sequence[str], *options: str) -> tuple[str, ...]:
    """Tests that fail on a copy with these faults."""
    if not tests:
        return ()
    with copy() as folder:
        for fault in faults:
            fault.plant(folder)
        return run_tests(folder, tests, *options)


class Search:
    """What was found so far, kept as it comes."""

    def __init__(self) -> None:
        """Take up earlier runs."""
        self.found: dict[str, dict[str, Any]] = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
        texts = {name: (ROOT / name).read_text() for name in tracked()
                 if name.startswith("tests/") and Path(name).match("test_*.py")}
        self.golden = [name for name in texts if name.startswith(GOLDEN)]
        self.files = {name: text for name, text in texts.items() if name not in self.golden}

    def run(self, faults: Sequence[Fault]) -> None:
        """Search with the stages that each fault has not passed until it is found; RuntimeError: tests fail without a fault."""
        for fault in faults:
            for stage, tests in zip(STAGES, near(fault, self.files), strict=False):
                if self.is_open(fault, stage):
                    self.search(fault, stage, tests)
        for stage, tests in zip(STAGES[2:], (list(self.files), self.golden), strict=True):
            left = [fault for fault in faults if self.is_open(fault, stage)]
            failed = run_with(left, tests) if len(left) > 1 else tests
            for fault in left:
                self.search(fault, stage, failed)
        unsure = [entry for fault in faults if (entry := self.entry(fault))["by"] and not entry["clean"]]
        if other := run_with([], sorted({entry["by"] for entry in unsure})):
            raise RuntimeError(f"{', '.join(other)} fail without any fault, too: mend them first")
        for entry in unsure:
            entry["clean"] = True
        self.save()

    def entry(self, fault: Fault) -> dict[str, Any]:
        """The test that found a fault, its stage, and whether it passes without; the stages passed before; the time [s]."""
        return self.found.setdefault(fault.breaks, {
            "by": None, "stage": None, "passed": [], "seconds": 0.0, "clean": False})

    def is_open(self, fault: Fault, stage: str) -> bool:
        """Whether a fault is still to be searched for with this stage."""
        return self.entry(fault)["by"] is None and stage not in self.entry(fault)["passed"]

    def search(self, fault: Fault, stage: str, tests: Sequence[str]) -> None:
        """Search for one fault with these tests, and keep the outcome."""
        begin, entry = time.monotonic(), self.entry(fault)
        failed = run_with([fault], tests, "-x")
        entry["seconds"] += round(time.monotonic() - begin, 1)
        if failed:
            entry |= {"by": failed[0], "stage": stage}
        else:
            entry["passed"].append(stage)
        print(f"{FAULTS.index(fault) + 1}, {stage}: {entry['by'] or 'not found'} ({entry['seconds']:.0f} s)",
              file=sys.stderr, flush=True)
        self.save()

    def save(self) -> None:
        """Write what was found."""
        RESULTS.parent.mkdir(exist_ok=True)
        with replacing(RESULTS) as temporary:
            temporary.write_text(json.dumps(self.found, indent=1) + "\n")


def table(found: Mapping[str, dict[str, Any]]) -> str:
    """The results for people."""
    done = [(i, fault, found[fault.breaks]) for i, fault in enumerate(FAULTS, 1) if fault.breaks in found]
    lines = ["| n | file | what is wrong | found by | stage | s |", "|---|---|---|---|---|---|"]
    lines += [f"| {i} | `{fault.path}` | {fault.breaks} | {each['by'] or '**missed**'} | {each['stage'] or ''} "
              f"| {each['seconds']:.0f} |" for i, fault, each in done]
    count, golden = (sum(each["by"] is not None and each["stage"] in of for _, _, each in done) for of in (STAGES, STAGES[-1:]))
    return "\n".join([*lines, "", f"{count} of {len(done)} planted faults are found, {golden} of them by tests/golden alone."])


def main() -> None:
    """Search for what is missing, or anew for the faults that are named, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", type=int, nargs="+", choices=range(1, len(FAULTS) + 1), metavar="N",
                        help="faults by their numbers, searched for even where there is a result")
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    given, search = parser.parse_args(), Search()
    faults = [FAULTS[i - 1] for i in given.only] if given.only else list(FAULTS)
    for fault in faults if given.only else ():
        search.found.pop(fault.breaks, None)
    search.run(faults)
    print(json.dumps(search.found, indent=1) if given.json else table(search.found))


if __name__ == "__main__":
    main()
