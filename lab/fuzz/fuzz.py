"""Damaged files of every kind against every reader: what escapes as something other than an error of dro-grasp's own?

Each case follows from the seed and its number alone: a sound file is damaged, and read as the product reads it, in a child
process with at most 4 GB of address space. One that dies, takes more than 20 s of CPU time, runs out of memory, or raises
another exception than a `DroGraspError` is a failure, and is printed with its number. `--only N` repeats one case with its
traceback; `--keep FOLDER` keeps the files of what escaped. `--record FILE` holds what was found so far: the same command goes
on where it was stopped, and with more `--cases` where it ended.

    python -m lab.fuzz.fuzz [--cases 100000] [--seed 0] [--kinds urdf mesh ...] [--record FILE] [--only N]
        [--keep FOLDER] [--json]
"""

from __future__ import annotations

import argparse
import collections
import json
import os
import random
import re
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dro_grasp.errors import DroGraspError
from dro_grasp.files import replacing
from lab.benchmarks.report import emit, options_of
from lab.fuzz.targets import TARGETS, attempt, make_seeds

LONGEST = 20.0
"""CPU time after which a case counts as a hang [s] (ours)."""
ASLEEP = 120.0
"""Time after which it does too if it computed for less than IDLE [s] (ours): it waits for something that never comes."""
IDLE = 1.0
"""CPU time that even a starved process gets in that time [s] (ours)."""
MEMORY = 4 * 10**9
"""Address space of the process that reads [bytes] (ours)."""
PART = 1000
"""Cases that one process reads (ours): its memory tells of them alone, and at most so many are lost when all is stopped."""


@dataclass
class Tally:
    """What became of the cases."""

    counts: dict[str, collections.Counter[str]] = field(default_factory=lambda: collections.defaultdict(collections.Counter))
    """By kind: refused, read, escape, memory, hang, crash."""
    failures: dict[str, list[int]] = field(default_factory=lambda: collections.defaultdict(list))
    """Numbers of cases by the way in which they fail."""
    slowest: tuple[float, str] = (0.0, "")
    """Longest CPU time [s], and its kind and number."""
    memory: int = 0
    """Largest resident set of a reading process [bytes]."""
    seconds: float = 0.0
    """Time that it took, in all runs together [s]."""

    def write(self, record: Path, seed: int, kinds: Sequence[str]) -> None:
        """Write what was found so far, for `read`."""
        what = {"seed": seed, "kinds": list(kinds), "counts": self.counts, "failures": self.failures, "slowest": self.slowest,
                "memory": self.memory, "seconds": self.seconds}
        with replacing(record) as temporary:
            temporary.write_text(json.dumps(what))

    @classmethod
    def read(cls, record: Path | None, seed: int, kinds: Sequence[str]) -> Tally:
        """What a record holds of these cases; nothing without one.

        Raises:
            SystemExit: It holds other cases.
        """
        tally = cls()
        if record is None or not record.exists():
            return tally
        found = json.loads(record.read_text())
        if (found["seed"], found["kinds"]) != (seed, list(kinds)):
            raise SystemExit(f"{record} holds seed {found['seed']} and kinds {' '.join(found['kinds'])}; give those, or "
                             "another file")
        tally.counts.update({kind: collections.Counter(counts) for kind, counts in found["counts"].items()})
        tally.failures.update(found["failures"])
        tally.slowest, tally.memory, tally.seconds = tuple(found["slowest"]), found["memory"], found["seconds"]
        return tally

    @property
    def cases(self) -> int:
        """How many there were."""
        return sum(sum(counts.values()) for counts in self.counts.values())


def kind_of(case: int, seed: int, kinds: Sequence[str]) -> str:
    """The kind of file of a case."""
    return random.Random(f"{seed}/{case}/kind").choices(kinds, [TARGETS[k].share for k in kinds])[0]


def run_case(case: int, seed: int, kind: str, seeds: Path, keep: Path | None) -> tuple[str, str]:
    """Damage and read: the outcome, and for a failure where it came from."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    folder = folder.rename(folder.with_name(f"{folder.name}-{case}"))
    try:
        target = TARGETS[kind]
        path = target.write(random.Random(f"{seed}/{case}"), seeds, folder)
        try:
            target.read(path)
            return "read", ""
        except DroGraspError as error:
            causes = [error]
            while causes[-1].__cause__ is not None:
                causes.append(causes[-1].__cause__)  # type: ignore[arg-type]
            return ("memory", place_of(error)) if any(isinstance(c, MemoryError) for c in causes) else ("refused", "")
        except MemoryError as error:
            return "memory", place_of(error)
        except Exception as error:
            if keep is not None:
                shutil.copytree(folder, keep / f"{kind}-{case}", dirs_exist_ok=True)
            return "escape", place_of(error)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def place_of(error: BaseException) -> str:
    """An exception in one line, with the last place in dro-grasp that it passed."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "dro_grasp" in f.filename or "fuzz" in f.filename]
    where = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"
    told = re.sub(r"\S*/fuzz-\w+-\d+/", "", str(error)).splitlines()
    return f"{type(error).__name__} at {where}: {told[0][:90] if told else ''}"


def child(cases: Sequence[int], args: argparse.Namespace, seeds: Path, pipe: int) -> None:
    """Run cases one after the other, and tell each before and after; it never returns."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    told, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    try:
        for case in cases:
            kind, begin = kind_of(case, args.seed, args.kinds), time.process_time()
            os.write(pipe, (json.dumps([case, kind, "begin", begin]) + "\n").encode())
            outcome, place = run_case(case, args.seed, kind, seeds, args.keep)
            os.write(pipe, (json.dumps([case, kind, outcome, place, time.process_time() - begin]) + "\n").encode())
    except BaseException:
        os.write(told, traceback.format_exc().encode())
        os._exit(70)
    os._exit(0)


def run_cases(args: argparse.Namespace, seeds: Path) -> Tally:
    """All cases; a child that ends before its last case is replaced by one that begins with the next."""
    tally = Tally.read(args.record, args.seed, args.kinds)
    left = list(range(tally.cases, args.cases))
    while left:
        begin, part = time.perf_counter(), left[:PART]
        reading, writing = os.pipe()
        process = os.fork()
        if process == 0:
            child(part, args, seeds, writing)
        os.close(writing)
        done, ended = follow(reading, process, tally)
        os.close(reading)
        _, status, used = os.wait4(process, 0)
        tally.memory = max(tally.memory, used.ru_maxrss * 1024)
        if ended is not None:
            case, kind, how = ended
            signalled = os.WIFSIGNALED(status)
            how = how or f"crash, {f'signal {os.WTERMSIG(status)}' if signalled else f'exit {os.WEXITSTATUS(status)}'}"
            tally.counts[kind]["hang" if how == "hang" else "crash"] += 1
            tally.failures[f"{kind}: {how}"].append(case)
        left = left[done + (ended is not None) :]
        tally.seconds += time.perf_counter() - begin
        if args.record is not None:
            tally.write(args.record, args.seed, args.kinds)
        print(f"{args.cases - len(left)} cases, {sum(map(len, tally.failures.values()))} failures", file=sys.stderr, flush=True)
    return tally


def follow(reading: int, process: int, tally: Tally) -> tuple[int, tuple[int, str, str] | None]:
    """Collect a child's outcomes: how many, and the case, its kind, and "hang" or "" if it ended within one."""
    done, current, buffer, used, since = 0, None, b"", 0.0, time.monotonic()
    while True:
        if not select.select([reading], [], [], 1.0)[0]:
            spent = cpu_seconds(process) - used
            if spent > LONGEST or (spent < IDLE and time.monotonic() - since > ASLEEP):
                os.kill(process, signal.SIGKILL)
                return done, (*current, "hang") if current else None
            continue
        data = os.read(reading, 65536)
        if not data:
            return done, (*current, "") if current else None
        *lines, buffer = (buffer + data).split(b"\n")
        for line in map(json.loads, lines):
            if line[2] == "begin":
                current, used, since = (line[0], line[1]), line[3], time.monotonic()
                continue
            (case, kind, outcome, place, seconds), current = line, None
            done += 1
            tally.counts[kind][outcome] += 1
            tally.slowest = max(tally.slowest, (seconds, f"{kind} {case}"))
            if outcome in ("escape", "memory"):
                tally.failures[f"{kind}: {outcome}: {place}"].append(case)
                print(f"case {case}, {kind}: {outcome}: {place}", file=sys.stderr, flush=True)


def cpu_seconds(process: int) -> float:
    """CPU time of a process so far [s]."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, run, print; 1 if there are failures."""
    parser = options_of(__doc__)
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="+", choices=list(TARGETS), default=list(TARGETS))
    parser.add_argument("--record", type=Path)
    parser.add_argument("--only", type=int)
    parser.add_argument("--keep", type=Path)
    args = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="fuzz-seeds-") as name:
        seeds = Path(name)
        os.environ["DRO_GRASP_CACHE"] = str(seeds)
        if (process := os.fork()) == 0:  # libraries that have used threads do not survive a fork
            make_seeds(seeds)
            os._exit(0)
        if os.waitpid(process, 0)[1] != 0:
            raise SystemExit("the sound files could not be made")
        if args.only is not None:
            kind, folder = kind_of(args.only, args.seed, args.kinds), args.keep or seeds / "only"
            folder.mkdir(exist_ok=True)
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
            attempt(TARGETS[kind].read, TARGETS[kind].write(random.Random(f"{args.seed}/{args.only}"), seeds, folder))
            return 0
        tally = run_cases(args, seeds)
    outcomes = ("read", "refused", "escape", "memory", "hang", "crash")
    rows = [[kind, sum(c.values()), *(c[o] for o in outcomes)] for kind, c in sorted(tally.counts.items())]
    rows.append(["all", *(sum(row[i] for row in rows) for i in range(1, len(outcomes) + 2))])  # type: ignore[misc]
    failed = {how: [len(cases), *cases[:5]] for how, cases in sorted(tally.failures.items(), key=lambda item: -len(item[1]))}
    values = {
        "seed": args.seed, "seconds": tally.seconds, "slowest": tally.slowest, "peak_bytes": tally.memory,
        "failures": failed, "kinds": {row[0]: dict(zip(("cases", *outcomes), row[1:], strict=True)) for row in rows}}
    emit("damaged files", rows, ["kind", "cases", *outcomes], values, args.json)
    if not args.json:
        for how, found in failed.items():
            print(f"{found[0]:6d} x {how}  (cases {', '.join(map(str, found[1:]))})")
        slowest = f"slowest {tally.slowest[1]}: {tally.slowest[0]:.1f} s"
        print(f"{values['seconds']:.0f} s; {slowest}; peak {tally.memory / 1e9:.2f} GB")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
