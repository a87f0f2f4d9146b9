"""`dro-grasp evaluate`: a trial of every grasp of a file."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dro_grasp.cli.inputs import Flag, Mass, ProtocolName, optional
from dro_grasp.cli.output import print_result, progress_bar, say_aside
from dro_grasp.errors import ObjectError, OptionError
from dro_grasp.files import check_output, given_path
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL

if TYPE_CHECKING:
    from dro_grasp.grasps.batch import GraspBatch
    from dro_grasp.hands.hand import Hand
    from dro_grasp.objects.shape import ObjectModel
    from dro_grasp.predict.problem import GraspProblem
    from dro_grasp.simulation.protocols import Protocol

SHARES = {"trials_held": "held", "fingers_in_contact": "fingers", "all_fingers_in_contact": "all fingers"}
"""Shares beside the success rate, in the JSON object, and their columns in the table."""


@dataclass(frozen=True)
class Evaluate:
    """Evaluate the grasps of a file in simulation and report success rates with 95 % intervals.

    Example: dro-grasp evaluate grasps.parquet --protocol robust
    """

    file: tyro.conf.Positional[Path]  # Grasp file, or a folder of them, as `generate` fills it for a folder of objects.
    protocol: ProtocolName = DEFAULT_PROTOCOL  # Protocol of the trial.
    friction: Annotated[float | None, optional("MU", "the protocol's")] = None
    """Friction coefficient between hand and object; the official release has 3."""
    hand: Annotated[str | None, optional("NAME|PATH", "the file's")] = None  # Hand to use instead of the one named in the file.
    object: Annotated[str | None, optional("NAME|PATH", "the file's")] = None
    """Mesh to use instead of the one named in the file, for a file with one object."""
    scale: Annotated[float | None, optional("FACTOR", "that of the file's object")] = None
    """Scale of the mesh given with --object."""
    mass: Mass = None
    """Mass of every object [kg], instead of the one that the file records."""
    contact_quality: Flag = False
    """Also measure the analytic metrics of DexGraspBench, with the protocol's friction: penetration, contact distance and
    force closure of the grasps as they are, without any motion."""
    output: Annotated[Path | None, optional("PATH", "not saved")] = None
    """Save the grasps with their results. Hand and object must be those that the grasps were made for."""
    json: Flag = False  # Print one JSON object instead of a table.

    def run(self) -> int:
        """Evaluate object by object, then report."""
        from dro_grasp.grasps.batch import GraspBatch, load_grasps
        from dro_grasp.grasps.sources import hand_of, require_one_object
        from dro_grasp.predict.stages import evaluate
        from dro_grasp.simulation.contacts import with_contacts
        from dro_grasp.simulation.protocols import changed

        rules = changed(self.protocol, friction=self.friction)
        if self.output is not None:
            folder = check_output(self.output, ".parquet").resolve().parent
            if folder == given_path(self.file).resolve():
                raise OptionError(f"--output {self.output} is in the folder whose grasps are evaluated, where they would be "
                                  "read twice from then on; name a file in another folder")
        begin = time.perf_counter()
        grasps = load_grasps(self.file)
        hand = hand_of(grasps, self.hand)
        compare("hand", grasps.hand, grasps.hand_sha256, hand, self.output)
        require_one_object(grasps, self.object, self.file)
        require_object(self.scale, self.object)
        problems, bare = self._problems(hand, grasps)
        evaluated: dict[str, GraspBatch] = {}
        with progress_bar("evaluating", self.json) as progress:
            while problems:  # what an object gathers in its trials goes with it
                name, problem, part = problems.pop(0)
                done = evaluate(problem, part, rules, progress, another=self.object is not None)
                evaluated[name] = with_contacts(hand, problem.obj, done, rules) if self.contact_quality else done
        if self.output is not None:
            done = GraspBatch.concatenate([*evaluated.values(), *bare.values()])
            done.replace(asked_of=grasps.asked_of).save(self.output)  # of objects without any grasp, too
        there = set(zip(grasps.object, grasps.object_sha256, strict=True))
        lost = {key[0]: num for key, num in grasps.asked_of.items() if key not in there}
        self._report(hand, rules, evaluated, lost, list(bare), time.perf_counter() - begin)
        return 0

    def _problems(
        self, hand: Hand, grasps: GraspBatch
    ) -> tuple[list[tuple[str, GraspProblem, GraspBatch]], dict[str, GraspBatch]]:
        """Problem and grasps of each object, checked before the first trial; apart from them the grasps on bare clouds."""
        from dro_grasp.grasps.sources import object_of, with_mass_of
        from dro_grasp.predict.problem import GraspProblem
        from dro_grasp.simulation.scene import require_simulable

        problems, bare = [], {}
        refusal: ObjectError | None = None
        for name, part in grasps.by_object():
            obj = object_of(part, self.object, self.scale, self.mass)
            compare("object", name, next(filter(None, part.object_sha256), ""), obj, self.output)
            try:
                require_simulable(hand, obj)
            except ObjectError as error:
                refusal = error
                bare[name] = part
            else:
                problems.append((name, GraspProblem(hand, obj), with_mass_of(part, obj)))
        if refusal is not None and not problems:
            raise refusal
        for name, part in bare.items():
            say_aside(f"warning: {name}: a bare point cloud has no trial; its {len(part)} grasps are left as they are")
        return problems, bare

    def _report(
        self, hand: Hand, rules: Protocol, evaluated: dict[str, GraspBatch], lost: dict[str, int], bare: list[str],
        seconds: float,
    ) -> None:
        """Print the rates of each object and of all; of what is `lost`, grasps were asked for, and none was found."""
        from dro_grasp.compare.metrics import mean_share, success_rate
        from dro_grasp.grasps.batch import GraspBatch
        from dro_grasp.simulation.contacts import NAMES
        from dro_grasp.simulation.outcome import count_failures, diagnose, next_steps

        rows = []
        for name, part in evaluated.items():
            held = int(part.success.sum())
            rows.append([name, part.out_of, len(part), held, held / part.out_of, *shares(part, hand, part.out_of).values()])
        rows += [[name, num, 0, 0, 0.0, *[None] * (len(rows[0]) - 5)] for name, num in lost.items()]
        done = GraspBatch.concatenate(list(evaluated.values()))
        success, asked = int(done.success.sum()), sum(row[1] for row in rows)
        (rate, low, high), beside = success_rate(success, asked), shares(done, hand, asked)
        report = {
            "file": str(self.file), "hand": hand.name, "protocol": rules.label, "asked": asked, "num": len(done),
            "success": success, "success_rate": rate, "interval_95": [low, high],
            **beside, "contact_quality": {name: float(done.extra[name].mean()) for name in NAMES if name in done.extra},
            "objects": {row[0]: dict(zip(("asked", "num", "success"), row[1:4], strict=True)) for row in rows},
            "bare_clouds": bare,
            "reasons": count_failures(done), "next": next_steps(done), "seconds": round(seconds, 3),
            "output": None if self.output is None else str(self.output),
        }
        note = f"{success} of {asked} succeeded: {rate:.1%} (95 %: {low:.1%} to {high:.1%})"
        if len(done) < asked:
            note += f"; {asked - len(done)} of the {asked} that were asked for had not been found"
        if "trials_held" in beside:
            mean, low, high = mean_share(done.robustness, asked)
            note += f", and held in {mean:.1%} of their trials (95 %: {low:.1%} to {high:.1%})"
        columns = ["object", "asked", "grasps", "success", "rate", *(SHARES[name] for name in beside)]
        means = ", ".join(f"{name.replace('_', ' ')} {mean:.3g}" for name, mean in report["contact_quality"].items())
        notes = [note, *([f"means: {means} (lengths in m)"] if means else []), *diagnose(done)]
        print_result(self.json, report, f"{hand.name}, protocol {rules.label}", columns, rows, *notes)


def require_object(scale: float | None, given: str | None) -> None:
    """Refuse the scale of an object that is not given: OptionError."""
    if scale is not None and given is None:
        raise OptionError(f"--scale is {scale:g}, for an object that is given; name the object, too: --object NAME|PATH")


def compare(kind: str, name: str, stored: str, given: Hand | ObjectModel, output: Path | None = None) -> None:
    """Tell of a hand or an object that is not the one that the grasps were made for; it is unknown of some imported ones."""
    from dro_grasp.grasps.sources import made_for_another

    if stored in {"", given.sha256}:
        return
    if output is not None:
        raise OptionError(f"the grasps were made for another {kind} '{name}' than the given {given.name} (hash {stored[:12]}, "
                          f"given {given.sha256[:12]}), and outcomes in {output} would pass for outcomes with their own; leave "
                          f"out --output, or generate grasps for this {kind} anew")
    say_aside(made_for_another(name, given.name))


def shares(grasps: GraspBatch, hand: Hand, asked: int) -> dict[str, float]:
    """Mean shares, as in SHARES: of its trials that a grasp holds in, if it has several, and of fingers in contact.

    The trials are those of the grasps that were asked for, the fingers those of the grasps that there are.
    """
    from dro_grasp.compare.metrics import finger_contact, mean_share

    held = [mean_share(grasps.robustness, asked)[0]] if bool(grasps.robustness.isfinite().all()) else []
    names = list(SHARES)[-2 - len(held):]
    return dict(zip(names, [*held, *finger_contact(grasps.fingers_in_contact, len(hand.fingers))], strict=True))
