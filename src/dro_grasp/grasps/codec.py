"""What the columns of a grasp file mean: from the fields of a GraspBatch to Arrow and back."""

from __future__ import annotations

import importlib.util
import re
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.geometry import se3
from dro_grasp.geometry.se3 import roma
from dro_grasp.grasps import columns
from dro_grasp.grasps.columns import CAMERA, FRAME, OBJECT_SCALE
from dro_grasp.grasps.schema import ASKED, ASKED_OF
from dro_grasp.grasps.table import fixed_column, float_column, floats

REQUIRED = ("object", "wrist_position", "wrist_quaternion_wxyz", "joints")
"""Columns without which a file holds no grasps."""
TEXT_TYPES = {columns.REASON: pa.string(), columns.FAILURE: pa.string(), columns.CONTACT_LINKS: pa.list_(pa.string())}
"""Types of the trial's further columns, which their values do not tell when all are unknown."""
SYNTHESISED = re.compile(r"\bsynthesis \d+\b")
"""Provenance of synthesised grasps, whose `score` is minus the energy in files without a column `energy`."""


def encode(batch: Any) -> tuple[dict[str, pa.Array], dict[str, Any]]:
    """Columns and header of a GraspBatch's file."""
    stored: dict[str, pa.Array] = {
        "object": pa.array(list(batch.object), pa.string()),
        "wrist_position": fixed_column(batch.T_object_wrist[:, :3, 3]),
        "wrist_quaternion_wxyz": fixed_column(batch.wrist_quaternion_wxyz),
        "joints": float_column(batch.joints),
    }
    stored |= {name: float_column(getattr(batch, name)) for name in (*columns.POSTURES, *columns.FLOATS)}
    stored["success"] = pa.array(batch.trial_success.cpu().numpy(), mask=(~batch.evaluated).cpu().numpy())
    stored["protocol"] = pa.array([p or None for p in batch.protocol], pa.string())
    for name in columns.TEXTS[1:]:
        stored[name] = pa.array(list(getattr(batch, name)), pa.string())
    stored["seed"] = pa.array(batch.seed.cpu().numpy())
    stored |= {name: _further_column(name, value) for name, value in batch.extra.items()}
    header = {"hand": batch.hand, "hand_sha256": batch.hand_sha256, "wrist_link": batch.wrist_link,
              "joint_names": list(batch.joint_names)}
    if batch.asked_of:
        header[ASKED] = [dict(zip(ASKED_OF, (*key, num), strict=True)) for key, num in batch.asked_of.items()]
    return stored, header


def _further_column(name: str, value: Any) -> pa.Array:
    if isinstance(value, Tensor):
        return float_column(value) if value.is_floating_point() else pa.array(value.cpu().numpy().tolist())
    return pa.array(list(value), TEXT_TYPES.get(name))


def decode(table: pa.Table, header: dict[str, Any], path: str) -> dict[str, Any]:
    """Constructor arguments of a GraspBatch from a grasp file's table and header.

    Raises:
        GraspFileError: Columns are missing, or poses are not finite.
    """
    missing = [name for name in REQUIRED if name not in table.column_names]
    if missing:
        raise GraspFileError(f"{path} lacks columns {missing} of a grasp file")
    n, n_dof = table.num_rows, len(header["joint_names"])

    def text(name: str) -> tuple[str, ...]:
        return tuple(v or "" for v in shared(table[name])) if name in table.column_names else ("",) * n

    def numbers(name: str, width: int | None) -> Float[Tensor, "n *width"]:
        if name not in table.column_names or table[name].null_count == n:
            return torch.full((n,) if width is None else (n, width), torch.nan)
        return floats(table[name], width, f"{path}, column {name}")

    joints = numbers("joints", n_dof)
    T = _poses(numbers("wrist_position", 3), numbers("wrist_quaternion_wxyz", 4))
    if not (T.isfinite().all() and joints.isfinite().all()):
        raise GraspFileError(f"{path} has grasps with missing or non-finite poses; write it without them")
    success = table["success"].to_pylist() if "success" in table.column_names else [None] * n
    protocol = tuple(columns.NOT_EVALUATED if s is None else p or columns.UNKNOWN_PROTOCOL
                     for p, s in zip(text("protocol"), success, strict=True))
    fields: dict[str, Any] = {name: text(name) for name in columns.TEXTS}
    fields |= {name: numbers(name, n_dof) for name in columns.POSTURES} | {name: numbers(name, None) for name in columns.FLOATS}
    if "energy" not in table.column_names:
        fields |= _energy_apart(fields["score"], fields["provenance"], table)
    known = {*columns.COLUMNS, *REQUIRED, "success"}
    extra = {name: _decode_further(table[name]) for name in table.column_names if name not in known}
    if not isinstance(extra.get(OBJECT_SCALE), Tensor):  # null for every grasp
        extra.pop(OBJECT_SCALE, None)
    _check_frames(extra, path)
    seed = [s or 0 for s in table["seed"].to_pylist()] if "seed" in table.column_names else [0] * n
    return {
        "T_object_wrist": T, "joints": joints,
        "hand": header["hand"], "hand_sha256": header["hand_sha256"], "wrist_link": header["wrist_link"],
        "joint_names": tuple(header["joint_names"]), "seed": torch.tensor(seed, dtype=torch.int64),
        "trial_success": torch.tensor([bool(s) for s in success], dtype=torch.bool), "protocol": protocol, **fields,
        "extra": extra, "asked_of": {(name, sha256): num for name, sha256, num in (
            (one[key] for key in ASKED_OF) for one in header.get(ASKED, ()))},
    }


def quaternions_wxyz(T: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n 4"]:
    """Unit quaternions of poses."""
    return roma.quat_xyzw_to_wxyz(roma.rotmat_to_unitquat(T[:, :3, :3].to(torch.float64))).to(T.dtype)


def _check_frames(extra: dict[str, Any], path: str) -> None:
    """Refuse grasps in a named frame in which the camera's pose is not known."""
    named = [i for i, frame in enumerate(extra.get(FRAME, ())) if frame]
    pose = extra.get(CAMERA)
    if named and not (isinstance(pose, Tensor) and pose.shape[1:] == (16,) and bool(pose[named].isfinite().all())):
        raise GraspFileError(f"{path} names the frame of its grasps, and '{CAMERA}' is no pose of 16 finite numbers for each "
                             "of them; write the file again")


def _poses(position: Float[Tensor, "n 3"], quaternion: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4 4"]:
    """Wrist poses of positions [m] and unit quaternions (WXYZ); NaN where a quaternion has another length."""
    length = quaternion.norm(dim=-1, keepdim=True)
    unit = torch.where((length - 1).abs() < 1e-2, quaternion / length, torch.nan)
    return se3.compose(roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(unit)), position)


def _energy_apart(score: Float[Tensor, " n"], provenance: tuple[str, ...], table: pa.Table) -> dict[str, Float[Tensor, " n"]]:
    """Energy and score in a file without a column `energy`: the score of its synthesised grasps is minus the energy."""
    terms = [name for name in table.column_names if name.startswith(columns.ENERGY_TERM)]
    has_terms = ~torch.from_numpy(np.array(table[terms[0]].is_null())) if terms else torch.zeros(len(score), dtype=torch.bool)
    synthesised = has_terms & torch.tensor([SYNTHESISED.search(p) is not None for p in provenance], dtype=torch.bool)
    nothing = torch.full_like(score, torch.nan)
    return {"energy": torch.where(synthesised, -score, nothing), "score": torch.where(synthesised, nothing, score)}


def data_frame(batch: Any) -> Any:
    """A pandas DataFrame with the columns of the batch's file.

    Raises:
        OptionError: pandas is not installed.
    """
    if importlib.util.find_spec("pandas") is None:
        raise OptionError("to_pandas needs pandas, which is not installed; install it with: pip install pandas")
    return pa.table(encode(batch)[0]).to_pandas()


def _decode_further(column: pa.ChunkedArray) -> Any:
    kind = column.type
    if pa.types.is_floating(kind):
        return floats(column, None, "extra")
    if column.null_count == 0 and (pa.types.is_boolean(kind) or pa.types.is_integer(kind)):
        return torch.tensor(column.to_pylist())
    if pa.types.is_list(kind) and pa.types.is_floating(kind.value_type):
        lengths = {len(v) for v in column.to_pylist() if v is not None}
        if len(lengths) == 1:
            return floats(column, lengths.pop(), "extra")
    return shared(column)


def shared(column: pa.ChunkedArray) -> list[Any]:
    """The values of a column, equal texts and lists once: of a million grasps most share their object and their maker."""
    if pa.types.is_string(column.type):
        coded = column.combine_chunks().dictionary_encode()
        words = [*coded.dictionary.to_pylist(), None]
        return [words[i] for i in coded.indices.fill_null(len(words) - 1).to_pylist()]
    values = column.to_pylist()
    if not (pa.types.is_list(column.type) and pa.types.is_string(column.type.value_type)):
        return values
    known: dict[tuple[Any, ...], Any] = {}
    return [value and known.setdefault(tuple(value), value) for value in values]
