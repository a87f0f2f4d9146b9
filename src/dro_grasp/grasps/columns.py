"""The columns of a grasp batch: which there are, what "unknown" is in each, how rows are taken and joined."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.files import MAX_QUOTED_CHARS, free_name
from dro_grasp.frames import ROUNDING, are_rotations

TRIAL_FLOATS = ("displacement", "rotation", "penetration", "robustness", "fingers_in_contact")
"""Columns of one number per grasp that a trial fills; NaN is unknown."""
CARRYING = ("payload", "squeeze_force")  # Columns of one number per grasp that closing in simulation fills; NaN is unknown
FLOATS = ("score", "energy", *TRIAL_FLOATS, *CARRYING)  # All columns of one number per grasp
POSTURES = ("pregrasp_joints", "squeeze_joints")  # Columns of one number per joint; a row of NaN is not stated
PER_JOINT = (*POSTURES, "squeeze_torque")  # The same, with the torques
TEXTS = ("object", "object_sha256", "split", "provenance")  # Columns of one string per grasp; the empty string is unknown
POSE_IN_FILES = ("wrist_position", "wrist_quaternion_wxyz")  # Columns of a grasp file that hold the pose of the wrist
COLUMNS = ("T_object_wrist", "joints", "seed", "trial_success", "protocol", *FLOATS, *PER_JOINT, *TEXTS)
"""Fields of a batch with one entry per grasp."""
MAY_BE_UNKNOWN = ("score", "energy", *CARRYING, *PER_JOINT)
"""Columns that say nothing about a grasp until somebody fills them; those of its trial are the others."""
NOT_EVALUATED = ""  # Protocol of a grasp without a trial
UNKNOWN_PROTOCOL = "unknown"  # Protocol of a grasp whose outcome is known without its protocol
LABEL = re.compile(r"[\w.-]+(\+[\w.,=+-]+)?(/\d+)?(, [\w.-]+(\+[\w.,=+-]+)?(/\d+)?)*")
"""How trials write their protocols: name, what differs from the protocol of this name, version; several after each other."""
MEASURED = ("trial_success", "protocol", *TRIAL_FLOATS)  # Fields of a batch that a trial fills
REASON = "reason"  # Further column: why a grasp failed, in words; empty for a success
FAILURE = "failure"  # Further column: name of the kind of failure (`Failure`); None for a success
CONTACT_LINKS = "contact_links"  # Further column: names of the links that touch the object after closing
FURTHER = (REASON, FAILURE, CONTACT_LINKS)  # Further columns that a trial adds
DEPTH = "depth"  # Further column of synthesized grasps: deepest penetration of a surface point [m]
RELABELLED = "relabelled"  # Further column of stored grasps: whether idle fingers were closed after the grasp was made
HAND_FILE = "hand_file"  # Further column: path of the hand's description, if the hand is a user's own
OBJECT_FILE = "object_file"  # Further column: path of the object, if it is a user's own
OBJECT_SCALE = "object_scale"  # Further column: scale of that file, or of the object of that name
OBJECT_CLOUD = "object_cloud"
"""Further column: the object, if it is a cloud that is in no file, as taken out of a scene; NPZ in base64."""
OBJECT_MASS = "object_mass"  # Further column: mass that was stated of the object [kg]; NaN for none
FRAME = "frame"  # Further column of grasps on a camera's cloud: name of the frame of the poses
CAMERA = "T_frame_camera"  # Further column of such grasps: pose of the camera in that frame, row by row [m]
TABLE = "table_plane"
"""Further column of grasps made for a table: upward unit normal of its plane and height along it in the object's frame [m]; NaN
for none."""
ENERGY_TERM = "energy_"  # How the names of further columns with the terms of the grasp energy begin
Asked = Mapping[tuple[str, str], int]  # How many grasps were asked for, by the name and hash of their object

HOLD_COLUMNS = ("held_joints", "held_torque", "empty_joints", "empty_torque", "hold_unit")
"""Further columns of a batch: joints [rad or m] and efforts [Nm or N] with the object in the hand and without, and what counts
as a radian to each joint: 1, or a length where it slides [m]."""
WEIGHT_COLUMN = "held_weight"
"""Further column: the object's weight [N]."""
OF_POSES = frozenset({
    DEPTH, *HOLD_COLUMNS, WEIGHT_COLUMN, "object_penetration", "deepest_self_penetration", "touching_links",
    "contact_distance", "contact_spread", "q1", "wrench_error"})
"""Further columns that belong to a pose and joints: depth, what to expect of a hold, and measures of contact."""


def require_fit(batch: Any, n_names: int) -> None:
    """Refuse columns of a batch that do not fit together: ValueError."""
    every, n = {name: getattr(batch, name) for name in COLUMNS} | batch.extra, len(batch)
    if wrong := {name: length for name, column in every.items() if (length := len(column)) != n}:
        raise ValueError(f"a batch of {n} grasps has columns of other lengths: {wrong}")
    if batch.joints.shape[1] != n_names:
        raise ValueError(f"{batch.joints.shape[1]} values for {n_names} joint names")
    if taken_names := sorted(batch.extra.keys() & {*COLUMNS, "success", *POSE_IN_FILES}):
        raise ValueError(f"further columns have the names of fields: {taken_names}; set the fields instead")
    if deep := {name: tuple(v.shape) for name, v in batch.extra.items() if isinstance(v, Tensor) and v.ndim > 2}:
        raise ValueError(f"further columns have more than two axes: {deep}; give (n) or (n k), or a column for each part")
    if bool((batch.trial_success & ~batch.evaluated).any()):
        raise ValueError("some grasps succeeded without a protocol; name the protocol of their trial")


def protocol_fault(protocol: Iterable[str]) -> str | None:
    """What is wrong with the first protocol that no trial could have written; None if nothing is."""
    wrong = next((name for name in set(protocol) if name != NOT_EVALUATED and not LABEL.fullmatch(name)), None)
    return wrong and (f"protocol {wrong[:60]!r} is unknown; trials state a name and a version, such as carry/1, and names are "
                      "of letters, digits, '_', '-' and '.'")


def placed(T_object_wrist: Any, joints: Any, n_dof: int) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "n n_dof"]]:
    """Poses and joints of grasps in single precision; OptionError: they are of another shape, not finite, or not rigid."""
    try:
        T, q = (torch.as_tensor(_own(values)).float() for values in (T_object_wrist, joints))
    except (TypeError, ValueError, RuntimeError) as error:
        raise OptionError(f"wrist poses or joints are no arrays of numbers ({error}); give rows of equal lengths") from error
    if T.ndim != 3 or T.shape[1:] != (4, 4) or q.ndim != 2 or q.shape != (len(T), n_dof):
        raise OptionError(f"wrist poses of shape {tuple(T.shape)} and joints of shape {tuple(q.shape)}; expected (n, 4, 4) and "
                          f"(n, {n_dof}) for this hand")
    if wrong := (~(T.isfinite().all(-1).all(-1) & q.isfinite().all(-1))).nonzero()[:, 0].tolist():
        raise OptionError(f"{_named(wrong)} a pose or joints that are not finite; leave out what is not finite")
    rigid = are_rotations(T[:, :3, :3]) & ((T[:, 3] - T.new_tensor([0, 0, 0, 1])).abs() <= ROUNDING).all(-1)
    if wrong := (~rigid).nonzero()[:, 0].tolist():
        raise OptionError(f"{_named(wrong)} a wrist pose that is no rigid motion; give rotation matrices, and metres beside "
                          "them")
    return T, q


def _named(wrong: Sequence[int]) -> str:
    """The first of some grasps by number and the count of the others, as the subject of a sentence, with its verb."""
    others = len(wrong) - 1
    return f"grasp {wrong[0]}{f' and {others} more have' if others else ' has'}"


def rows_at(index: Any, n: int) -> Int[Tensor, " k"]:
    """The rows of a batch of n grasps that an index, slice, list, index tensor or mask chooses.

    Errors are those of `GraspBatch.__getitem__`; True and False are no rows: as masks without axes they would choose all or
    none.
    """
    if isinstance(index, slice):
        return torch.tensor(range(n)[index], dtype=torch.long)
    try:
        chosen = torch.as_tensor(_own(index)).cpu()
    except (TypeError, ValueError, RuntimeError):  # what PyTorch raises for things that are no arrays of numbers
        chosen = None
    if chosen is not None and not chosen.numel():
        return torch.empty(0, dtype=torch.long)
    mask = chosen is not None and chosen.dtype == torch.bool
    if chosen is None or chosen.is_floating_point() or chosen.is_complex() or (mask and chosen.ndim != 1):
        raise OptionError(f"{str(index)[:MAX_QUOTED_CHARS]} chooses no grasps; give an index, a slice, a list of indices, or a "
                          "mask with one truth value a grasp")
    chosen = chosen if mask else chosen.long()
    if (not mask and bool(((chosen < -n) | (chosen >= n)).any())) or (mask and len(chosen) != n):
        raise IndexError(f"mask of {len(chosen)} for a batch of {n}" if mask else f"grasp {index} of a batch of {n}")
    return torch.arange(n)[chosen].reshape(-1)


def places(objects: Sequence[str], hashes: Sequence[str]) -> dict[str, list[int]]:
    """The rows of each object, in the order in which the objects first appear.

    Objects of one name and several hashes are several: the first has the name, the others have a number after it. Where a
    hash is unknown, the object is the first of its name.
    """
    first = {name: sha256 for name, sha256 in zip(reversed(objects), reversed(hashes), strict=True) if sha256}
    others, labels = set(objects), dict[tuple[str, str], str]()
    rows: dict[str, list[int]] = {}
    for i, (name, sha256) in enumerate(zip(objects, hashes, strict=True)):
        key = name, sha256 or first.get(name, "")
        if key not in labels:
            labels[key] = name if name not in rows else free_name(name, others | set(rows), numbered=" ({})")
        rows.setdefault(labels[key], []).append(i)
    return rows


def _objects(batch: Any) -> set[tuple[str, str]]:
    return set(zip(batch.object, batch.object_sha256, strict=True))


def asked_once(batch: Any, num: int) -> Asked:
    """What one request for `num` grasps of one object asked for; OptionError: there are more grasps, or several objects."""
    objects = sorted(_objects(batch))
    if len(objects) > 1:
        raise OptionError(f"one request is for one object, the grasps are of {', '.join(name for name, _ in objects)}; state "
                          "for each how many were asked for, then join them")
    if len(batch) > num:
        raise OptionError(f"{len(batch)} grasps of a request for {num} are too many; return the best {num}")
    return {(objects[0] if objects else ("", "")): num}


def asked_in_all(batch: Any) -> int | None:
    """How many grasps of all objects of a batch were asked for; None if that of one of them is unknown."""
    return None if not batch.asked_of or _objects(batch) - batch.asked_of.keys() else sum(batch.asked_of.values())


def asked_among(asked: Asked, batch: Any) -> Asked:
    """The part that is of the objects of a batch."""
    own = _objects(batch)
    return {key: num for key, num in asked.items() if key in own}


def asked_joined(batches: Sequence[Any]) -> Asked:
    """The sum for each object of which every batch with its grasps knows the number."""
    total = Counter[tuple[str, str]]()
    for batch in batches:
        total.update(batch.asked_of)
    unknown = {key for batch in batches for key in _objects(batch) - batch.asked_of.keys()}
    return {key: num for key, num in total.items() if key not in unknown}


def filled(joints: Float[Tensor, "n n_dof"], known: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """All fields of a batch but poses and joints: known, given or unknown; OptionError: a column is none, or does not fit."""
    n = len(joints)
    fields: dict[str, Any] = {name: unknown(name, joints) for name in COLUMNS[2:]} | dict(known)
    names = [name.replace("trial_success", "success") for name in fields]
    if wrong := [name for name in given if name not in {*names, "extra"}]:
        raise OptionError(f"grasps have no column '{wrong[0]}'; they have {', '.join(names)}, and in extra, a dictionary, what "
                          "you like")
    if "success" in given:
        fields["protocol"] = (UNKNOWN_PROTOCOL,) * n
        fields["trial_success"] = _numbers("success", given["success"], fields["trial_success"])
    for name, value in given.items():
        if name == "success":
            continue
        if isinstance(fields.get(name), Tensor):
            fields[name] = _numbers(name, value, fields[name])
        elif name == "extra":
            fields[name] = {each: _further(column) for each, column in value.items()}
        else:
            fields[name] = tuple(value.tolist()) if isinstance(value, np.ndarray) else value
    if isinstance(fields["provenance"], str):
        fields["provenance"] = (fields["provenance"],) * n
    for name in (*TEXTS, "protocol"):
        if not isinstance(texts := fields[name], list | tuple) or not all(isinstance(text, str) for text in texts):
            raise OptionError(f"{name} is {str(texts)[:MAX_QUOTED_CHARS]!r}; give one text for each of the {n} grasps")
        if len(texts) != n:
            raise OptionError(f"{name} has {len(texts)} texts; give one for each of the {n} grasps")
        fields[name] = tuple(texts)
    return fields


def _numbers(name: str, value: Any, like: Shaped[Tensor, "n *k"]) -> Shaped[Tensor, "n *k"]:
    """A given column in type, shape and place of an unknown one; one seed stands for all."""
    try:
        column = torch.as_tensor(_own(value))
        if column.is_floating_point() and not like.is_floating_point():
            raise ValueError("it has fractions")
        column = column.to(like.device, like.dtype)
    except (TypeError, ValueError, RuntimeError) as error:
        raise OptionError(f"{name} is no array of numbers ({error}); give one of shape {tuple(like.shape)}, or leave it "
                          "out") from error
    if name == "seed" and column.ndim == 0:
        return column.repeat(len(like))
    if column.shape != like.shape:
        raise OptionError(f"{name} has shape {tuple(column.shape)}; expected {tuple(like.shape)} for these grasps")
    return column


def _further(column: Any) -> Any:
    """A given further column; arrays become tensors, of floats in single precision, or lists."""
    if not isinstance(column, np.ndarray):
        return column
    if column.dtype.kind not in "biuf":
        return column.tolist()
    return torch.as_tensor(_own(column), dtype=torch.float32 if column.dtype.kind == "f" else None)


def _own(value: Any) -> Any:
    """A copy of an array, as tensors take none with negative strides, and warn of one that is read-only."""
    return np.array(value) if isinstance(value, np.ndarray) else value


def outcomes(trial: Any, n: int, extra: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of n grasps, and further columns beside these, that state the outcome of a trial, a TrialResult."""
    further = {
        REASON: list(trial.reason), CONTACT_LINKS: [list(links) for links in trial.contact_links],
        FAILURE: [failure.name if failure else None for failure in trial.failure],
    }
    return {
        "trial_success": trial.success, "displacement": trial.displacement.amax(-1), "rotation": trial.rotation.amax(-1),
        "penetration": trial.penetration, "robustness": trial.robustness,
        "fingers_in_contact": trial.fingers_in_contact.float(), "protocol": (trial.protocol,) * n,
        "extra": {**extra, **further},
    }


def table_planes(batch: Any) -> Float[Tensor, "n 4"] | None:
    """The table of each grasp, NaN for none; None where no grasp has one. ValueError: the column holds something else."""
    column = batch.extra.get(TABLE)
    if column is None or not len(batch):
        return None
    try:
        rows = column if isinstance(column, Tensor) else [[torch.nan] * 4 if row is None else list(row) for row in column]
        planes = torch.as_tensor(rows, dtype=torch.float32).reshape(len(batch), 4)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"column {TABLE} is no plane a grasp ({error}); give four numbers, the upward unit normal and the "
                         "height along it in metres, or call the column something else") from error
    return planes if bool(planes.isfinite().any()) else None


def unknown(name: str, joints: Float[Tensor, "n n_dof"]) -> Any:
    """A column, not the pose or the joints, that says nothing about any grasp of a batch with these joints."""
    n = len(joints)
    if name in FLOATS:
        return torch.full((n,), torch.nan, device=joints.device)
    if name in PER_JOINT:
        return torch.full_like(joints, torch.nan)
    if name in {"seed", "trial_success"}:
        return torch.zeros(n, dtype=torch.int64 if name == "seed" else torch.bool, device=joints.device)
    return ("",) * n


def taken(column: Any, rows: Int[Tensor, " k"]) -> Any:
    """Some rows of a column."""
    return column[rows] if isinstance(column, Tensor) else type(column)(column[i] for i in rows.tolist())


def joined(parts: Sequence[Any], lengths: Sequence[int]) -> Any:
    """One column after the other; a part that is None stands for as many unknown entries as its length says.

    Unknown is NaN in floats and None in everything else, which then becomes a list.
    """
    present = [part for part in parts if part is not None]
    same = all(isinstance(p, Tensor) and p.shape[1:] == present[0].shape[1:] for p in present)
    if same and (len(present) == len(parts) or present[0].is_floating_point()):
        shape = present[0].shape[1:]
        return torch.cat([
            present[0].new_full((n, *shape), torch.nan) if part is None else part
            for part, n in zip(parts, lengths, strict=True)
        ])
    rows = [
        [None] * n if part is None else part.tolist() if isinstance(part, Tensor) else list(part)
        for part, n in zip(parts, lengths, strict=True)
    ]
    return (tuple if isinstance(present[0], tuple) else list)(row for part in rows for row in part)
