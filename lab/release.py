"""Check what a release ships: build wheel and sdist, install each extra in a fresh environment, use it far from the clone.

    python -m lab.release [--extras core apps ...] [--python python3.12 ...] [--folder out/release]

Downloads packages. Each environment has nothing but the wheel, its dependencies and pip; commands run in an empty folder,
without the development assets. Prints a table, and ends with code 1 where a check failed. What cannot be tried here, such as a
GPU, is imported alone.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tarfile
import time
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from lab.benchmarks.report import ROOT

MOST = 6_000_000
"""Largest wheel [bytes]."""
NOT_SHIPPED = ("tests/", "lab/", "data/", "docs/", "scripts/")
"""Folders of the clone that no wheel has."""
GRASPS = "grasps.parquet"
GENERATE = f"dro-grasp generate --hand allegro --object rubber_duck --num 2 --output {GRASPS} --picture grasps.png --json"
CORE = {
    "generate": GENERATE,
    "evaluate": f"dro-grasp evaluate {GRASPS} --protocol robust --json",
    "picture": f"dro-grasp picture {GRASPS} --output sheet.png",
    "export": f"dro-grasp export {GRASPS} --format isaac_grasp --output grasps.yaml",
    "weights": "dro-grasp weights verify",
    "types": "python -c 'import dro_grasp, pathlib; assert (pathlib.Path(dro_grasp.__file__).parent / \"py.typed\").exists()'",
}
"""What every environment does, by name."""
REFUSED = {"view without apps": ("apps", f"dro-grasp view {GRASPS}"),
           "robot without arm": ("arm", "dro-grasp plan --robot xarm7_leaphand --object can --at 0.5 0 0")}
"""What the core refuses, naming the extra."""
PAGE = """
import subprocess, sys, time, urllib.request
page = subprocess.Popen([sys.argv[1], *sys.argv[3:]], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
for _ in range(120):
    time.sleep(1)
    try:
        assert b"<html" in urllib.request.urlopen(f"http://127.0.0.1:{sys.argv[2]}", timeout=5).read().lower()
    except OSError:
        assert page.poll() is None, page.stderr.read()
        continue
    break
else:
    sys.exit("no page in two minutes")
page.terminate()
sys.exit(page.wait(30))
"""
"""Opens a page of a command as a browser begins to, and stops it."""
EXTRAS: dict[str, dict[str, str]] = {
    "core": {},
    "apps": {"view": f"python page.py dro-grasp 18099 view {GRASPS} --port 18099"},
    "arm": {"robot": "dro-grasp robot check xarm7_leaphand",
            "plan": "dro-grasp plan --robot xarm7_leaphand --object can --at 0.5 0 0.1 --num 2 --output plan.json"},
    "usd": {"usd": f"dro-grasp export {GRASPS} --format usd --output grasps.usda"},
    "pandas": {"pandas": f"python -c 'import pandas; assert len(pandas.read_parquet(\"{GRASPS}\")) == 2'"},
    "tensorboard": {"curves": "dro-grasp synthesize --hand gripper3 --object can --grasps 4 --output data && "
                    "dro-grasp dataset bundle data --output b.safetensors && dro-grasp train --bundle b.safetensors "
                    "--run-folder run --steps 2 --output w.safetensors --tensorboard"},
    "descriptions": {"descriptions": "python -c 'import robot_descriptions'"},
    "ray": {"ray": "dro-grasp synthesize --hand gripper3 --object can --grasps 4 --output data --engine ray"},
    "gpu": {"warp": "python -c 'import mujoco_warp'"},
}
"""What each extra is for."""
KEPT = ("HOME", "PATH", "LANG", "TMPDIR", "PIP_INDEX_URL", "PIP_EXTRA_INDEX_URL", "PIP_CACHE_DIR", "SSL_CERT_FILE",
        "REQUESTS_CA_BUNDLE", "HTTPS_PROXY", "https_proxy", "HTTP_PROXY", "http_proxy", "NO_PROXY", "no_proxy")
"""Variables that a fresh environment inherits."""


@dataclass(frozen=True)
class Row:
    """A check and what came of it."""

    where: str
    check: str
    good: bool
    told: str


def main(argv: Sequence[str] | None = None) -> int:
    """Check, print; 1 if a check failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--extras", nargs="+", choices=list(EXTRAS), default=list(EXTRAS), help="environments to make")
    parser.add_argument("--python", nargs="+", default=[sys.executable], help="interpreters; all but the first try the core")
    parser.add_argument("--folder", type=Path, default=ROOT / "out" / "release", help="where all is built; emptied before")
    options = parser.parse_args(argv)
    folder = options.folder.resolve()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    rows = []
    for row in checks(folder, options.python, options.extras):
        print(f"{row.where}: {row.check}: {'good' if row.good else 'FAILED'} {row.told}", flush=True)
        rows.append(row)
    table = Table(title="release")
    for column in ("where", "check", "result", ""):
        table.add_column(column, overflow="fold")
    for row in rows:
        table.add_row(row.where, row.check, "good" if row.good else "[red]failed", row.told)
    Console().print(table)
    return int(not all(row.good for row in rows))


def checks(folder: Path, pythons: Sequence[str], extras: Sequence[str]) -> Iterator[Row]:
    """Every check as it is done."""
    yield from built(folder, pythons[0])
    wheels = list(folder.glob("dist/*.whl"))
    if len(wheels) != 1:
        return
    for extra in extras:
        yield from tried(folder, pythons[0], wheels[0], extra)
    for python in pythons[1:]:
        yield from tried(folder, python, wheels[0], "core")


def built(folder: Path, python: str) -> Iterator[Row]:
    """Wheel and sdist, and what is in them."""
    builder = folder / "builder"
    yield run("build", "environment", f"{python} -m venv {builder} && {builder}/bin/pip install --quiet build twine", folder)
    # The wheel is made from the sdist, so the sdist holds all that it takes.
    yield run("build", "sdist and wheel", f"{builder}/bin/python -m build --outdir {folder}/dist {ROOT}", folder)
    yield run("build", "metadata", f"{builder}/bin/twine check --strict {folder}/dist/*", folder)
    for wheel in folder.glob("dist/*.whl"):
        size = wheel.stat().st_size
        yield Row("wheel", f"at most {MOST / 1e6:.0f} MB", size <= MOST, f"{size / 1e6:.2f} MB")
        with zipfile.ZipFile(wheel) as archive:
            names = archive.namelist()
        wrong = [name for name in names if name.startswith(NOT_SHIPPED)]
        lacking = [end for end in ("/licenses/LICENSE", "/weights/SHA256SUMS", "/py.typed") if not any(
            name.endswith(end) for name in names)]
        yield Row("wheel", "content", not wrong and not lacking, ", ".join([*wrong[:3], *(f"no {end}" for end in lacking)])
                  or f"{len(names)} files")
    for sdist in folder.glob("dist/*.tar.gz"):
        with tarfile.open(sdist) as archive:
            count = len(archive.getnames())
        yield Row("sdist", "content", True, f"{count} files, {sdist.stat().st_size / 1e6:.1f} MB")


def tried(folder: Path, python: str, wheel: Path, extra: str) -> Iterator[Row]:
    """An environment with an extra, and its commands."""
    name = extra if python == sys.executable else f"{extra}, {Path(python).name}"
    home = folder / name.replace(", ", "-")
    what = str(wheel) if extra == "core" else f"{wheel}[{extra}]"
    install = run(name, "install", f"{python} -m venv {home}/env && {home}/env/bin/pip install --quiet '{what}'", folder)
    yield install
    if not install.good:
        return
    away = home / "away"
    away.mkdir()
    (away / "page.py").write_text(PAGE)
    yield run(name, "pip check", "pip check", away, home)
    for check, line in {**CORE, **EXTRAS[extra]}.items():
        yield run(name, check, line, away, home)
    if extra == "core":
        for check, (needed, line) in REFUSED.items():
            yield run(name, check, line, away, home, refused=f"dro-grasp[{needed}]")


def run(where: str, check: str, line: str, folder: Path, home: Path | None = None, refused: str = "") -> Row:
    """One command line, in a fresh environment if `home` has one; `refused` is what it has to say when it fails."""
    known = {key: value for key, value in os.environ.items() if key in KEPT}
    if home is not None:
        known["PATH"] = f"{home}/env/bin{os.pathsep}/usr/bin{os.pathsep}/bin"
        known["DRO_GRASP_CACHE"] = str(home / "cache")
    begin = time.monotonic()
    done = subprocess.run(line, shell=True, cwd=folder, env=known, capture_output=True, text=True, executable="/bin/bash")
    said = (done.stderr.strip() or done.stdout.strip()).splitlines()
    good = done.returncode == 0 if not refused else done.returncode != 0 and refused in done.stderr
    return Row(where, check, good, f"{time.monotonic() - begin:.0f} s" if good else " ".join(said[-3:])[-300:])


if __name__ == "__main__":
    sys.exit(main())
