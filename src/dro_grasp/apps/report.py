"""What is told of the grasps of one object: by `generate`, and by a grasp server in its place."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, NamedTuple

from dro_grasp.compare.metrics import success_rate
from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import percent
from dro_grasp.grasps.columns import CONTACT_LINKS, REASON
from dro_grasp.grasps.forces import forces_of_all, known, short
from dro_grasp.simulation.outcome import count_failures, diagnose, next_steps
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, protocol

if TYPE_CHECKING:
    from dro_grasp.grasps.batch import GraspBatch
    from dro_grasp.objects.shape import ObjectModel
    from dro_grasp.predict.constraints import Constraints
    from dro_grasp.predict.predictor import Prediction

ROWS_SHOWN = 16  # Grasps listed in the table
NO_TRIAL = "none"  # The protocol that stands for no trial


class Told(NamedTuple):
    """What is told of the grasps of one object."""

    report: dict[str, Any]  # the JSON object; files and times are still empty
    rows: list[list[Any]]  # the table's, for the first grasps
    lines: list[str]  # what stands under it


def told_of(
    obj: ObjectModel, made: Prediction, grasps: GraspBatch, *, hand: str, num: int, seed: int, weights: str, protocol: str,
    frame: str,
) -> Told:
    """What is told of predicted grasps, which may have been tried since, and repeated of what was asked for."""
    simulated = bool(grasps.evaluated.any())
    success = int(grasps.success.sum()) if simulated else None
    rate, *interval = success_rate(success or 0, num)
    optimised = set(made.origin) == {"optimiser"}
    report = {
        "hand": hand, "object": obj.name, "num": len(grasps), "asked": num, "shortage": made.shortage,
        "candidates": made.candidates, "dropped": made.dropped, "origin": dict(Counter(made.origin)), "origins": made.origin,
        "payload": grasps.payload.tolist(), "squeeze_force": grasps.squeeze_force.tolist(), "seed": seed,
        "weights": weights, "protocol": protocol, "success": success, "success_rate": rate if simulated else None,
        "interval_95": interval if simulated else None, "reasons": count_failures(grasps),
        "next": next_steps(grasps, optimised), "seconds": {}, "output": None, "picture": None, "frame": frame,
    }
    return Told(report, _rows(grasps, made.origin), _lines(report, grasps, optimised))


def _rows(grasps: GraspBatch, origin: list[str]) -> list[list[Any]]:
    rows = []
    for i in range(min(len(grasps), ROWS_SHOWN)):
        outcome: list[Any] = [None] * 4
        if grasps.evaluated[i]:
            outcome = [bool(grasps.success[i]), len(grasps.extra[CONTACT_LINKS][i]), float(grasps.penetration[i]) * 1e3,
                       grasps.extra[REASON][i]]
        forces = (None if x is None else short(x) for x in (known(grasps.payload[i]), known(grasps.squeeze_force[i])))
        rows.append([i, origin[i], percent(float(grasps.confidence[i])), *forces, *outcome])
    return rows


def _lines(report: dict[str, Any], grasps: GraspBatch, optimised: bool) -> list[str]:
    lines = []
    if report["dropped"]:
        reasons = ", ".join(f"{count} {reason}" for reason, count in report["dropped"].items())
        lines.append(f"{report['candidates']} candidates; dropped: {reasons}")
    if report["success"] is not None:
        found = "" if report["num"] == report["asked"] else f", {report['num']} were found"
        lines.append(f"{report['success']} of {report['asked']} grasps succeeded under protocol {report['protocol']}{found}")
        lines += diagnose(grasps, optimised)
    if told := forces_of_all(grasps):
        lines.append(f"they {told}")
    return lines


def protocol_for(obj: ObjectModel, given: str | None) -> str:
    """The protocol of the trials: the given one, or by default none for a bare cloud."""
    return given or (NO_TRIAL if obj.is_cloud else DEFAULT_PROTOCOL)


def require_trial(obj: ObjectModel, given: str | None, only_successful: bool) -> None:
    """Refuse unknown protocols, a trial of a bare cloud, and to keep the successful grasps of what gets none: OptionError."""
    if given is not None and given != NO_TRIAL:
        protocol(given)
    if obj.is_cloud and given not in {None, NO_TRIAL}:
        raise OptionError(f"protocol='{given}' asks for a trial, and '{obj.name}' is a bare point cloud; a trial needs a mesh "
                          "(object=...), or leave out protocol=...")
    if only_successful and protocol_for(obj, given) == NO_TRIAL:
        raise OptionError(f"only_successful=True saves what passed a trial, and '{obj.name}' gets none; name a "
                          "protocol=..., which needs a mesh, or leave out only_successful=...")


def doubt(constraints: Constraints, obj: ObjectModel, seen: bool) -> str | None:
    """What is odd about the table, in words; None for nothing. `seen` tells whether a camera's pose is known."""
    if obj.is_cloud and obj.table is None and constraints.table is not None and not seen:
        return (f"table={constraints.table:g} counts along the z axis of the cloud. If that is a camera's, which points "
                "forward, give the camera's pose with camera=...")
    return constraints.warning(obj)
