"""Make data, labels and weights by commands of this repository.

    python -m lab.recipe data labels weights [--folder out] [--tiny] [--device auto] [--workers N] [--minutes M]
        [--grasps FOLDER] [--list]

A rerun goes on where the last run was stopped or killed: steps that are done, of the same command on the same files, are not
run again. `FOLDER/recipe.json` states what was run, on what, how long. `--tiny` rehearses everything in minutes, without
assets; its weights are good for nothing and stay in its folder.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from hashlib import sha256
from typing import Any

from dro_grasp.devices import choose_device
from dro_grasp.files import command as in_words, replacing
from dro_grasp.provenance import commit
from lab.benchmarks.report import ROOT
from lab.recipe.parts import fingerprint
from lab.recipe.steps import FULL, STAGES, TINY, Step
from lab.runner import words

RECORD = "recipe.json"
"""File in the folder with what was run."""
FEEDING = 2
"""Most processes that feed a device; each takes its share of the cores for what stays on the processor (docs/data.md)."""
PR_SET_PDEATHSIG = 1
"""Of Linux's prctl: the signal that a process gets when its parent dies."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run what is missing of the stages that are named; the exit code of the first step that fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stages", nargs="+", choices=list(STAGES), help="what to make")
    parser.add_argument("--folder", default="out", help="where everything is made")
    parser.add_argument("--tiny", action="store_true", help="rehearse in minutes")
    parser.add_argument("--device", default="auto", help="cpu, cuda, or auto")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1,
                        help=f"processes on the processor; with a device, threads of the {FEEDING} processes that feed it")
    parser.add_argument("--minutes", type=float, help="time limit of `data`, divided among its steps; run again to go on")
    parser.add_argument("--grasps", help="of these `weights` are made, instead of what `labels` made in the folder")
    parser.add_argument("--list", action="store_true", help="only print the commands")
    options = parser.parse_args(argv)
    for path in (options.folder, options.grasps or ""):
        if path and shlex.quote(path) != path:
            parser.error(f"'{path}' has a space or another character that a command line takes apart; name another folder")
    device = choose_device(options.device)
    if "weights" in options.stages and not (options.tiny or options.list) and commit().endswith("+"):
        print("weights state the commit of the code that makes them; commit your changes first, and leave the code as it is "
              "until they are done, for instance in a worktree of its own", file=sys.stderr)
        return 2
    size = TINY if options.tiny else FULL
    if options.grasps:
        size = replace(size, learned=options.grasps)
    for stage in options.stages:
        for step in STAGES[stage](size, options.folder):
            made = Attempt(step, options.folder, options.workers, device, options.minutes, options.tiny)
            if options.list:
                print(made.told())
            elif code := made.run():
                print(f"{stage}: {step.name} failed; run the same command again to go on", file=sys.stderr)
                return code
    return 0


def end_with_parent() -> None:
    """Let Linux end this process with the one that started it, so that a step does not go on behind a killed run."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


class Attempt:
    """A step with the options of this run."""

    def __init__(
        self, step: Step, folder: str, workers: int, device: str, minutes: float | None, changed: bool = False
    ) -> None:
        """`changed` takes what code made that no commit holds."""
        self.step, self.record, self.changed = step, ROOT / folder / RECORD, changed
        feeds = device != "cpu" and "{device}" in step.free
        self.workers, self.threads = (min(workers, FEEDING), workers) if feeds else (workers, 1)
        self.device, self.minutes = device, minutes
        self.command = step.command.replace("{folder}", folder)
        self.read = fingerprint(ROOT / path for path in step.reads) if all((ROOT / p).exists() for p in step.reads) else ""
        digits = sha256(f"{self.command} {self.read}".encode()).hexdigest()[:8]
        self.command = self.command.replace("{run}", f"{folder}/runs/{step.name}-{digits}")

    def words(self) -> list[str]:
        """The command line."""
        free = shlex.split(self.step.free)
        if self.minutes is None and "--minutes" in free:
            free = free[:free.index("--minutes")]
        limit = (self.minutes or 0) * self.step.share
        told = [word.format(workers=self.workers, device=self.device, minutes=f"{limit:.3g}") for word in free]
        line = [*words(self.command), *told]
        if self.step.processes and self.device == "cpu" and self.workers > 1:
            return [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *line[1:]]
        return line

    def told(self) -> str:
        """The command line as a user types it."""
        return in_words("python", *self.words()[1:]).replace("python -m dro_grasp ", "dro-grasp ")

    def done(self) -> bool:
        """Whether it was run to its end, by the same command on the same files, with code that a commit holds."""
        known = self._known().get(self.step.name, {})
        return bool(self.step.makes) and (ROOT / self.step.makes).exists() and (
            known.get("command"), known.get("read")) == (self.command, self.read) and (
            self.changed or not known.get("commit", "").endswith("+"))

    def run(self) -> int:
        """Run it, unless it is done; its exit code."""
        if self.done():
            print(f"{self.step.name}: done before", flush=True)
            return 0
        print(f"{self.step.name}: {self.told()}", flush=True)
        if self.step.makes:
            (ROOT / self.step.makes).parent.mkdir(parents=True, exist_ok=True)
        environment = {**os.environ, "PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{ROOT}", "OMP_NUM_THREADS": str(self.threads)}
        begin = time.monotonic()
        code = subprocess.run(self.words(), cwd=ROOT, env=environment, preexec_fn=end_with_parent).returncode
        if code == 0:
            self._keep({"command": self.command, "read": self.read, "commit": commit(), "device": self.device,
                        "seconds": round(time.monotonic() - begin, 1)})
        return code

    def _known(self) -> dict[str, Any]:
        return json.loads(self.record.read_text()) if self.record.exists() else {}

    def _keep(self, entry: dict[str, Any]) -> None:
        self.record.parent.mkdir(parents=True, exist_ok=True)
        with replacing(self.record) as temporary:
            temporary.write_text(json.dumps({**self._known(), self.step.name: entry}, indent=1))


if __name__ == "__main__":
    sys.exit(main())
