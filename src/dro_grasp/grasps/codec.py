"""What the columns of a grasp file mean: from the fields of a GraspBatch to Arrow and back."""

from __future__ import annotations

from typing import Any

import pyarrow as pa
import roma
import torch
from torch import Tensor

from dro_grasp.errors import GraspFileError
from dro_grasp.grasps.table import fixed_column, float_column, floats

FLOATS = ("score", "displacement", "rotation", "penetration")
"""Fields of one number a grasp that may be missing."""
LISTS = ("pregrasp_joints", "squeeze_joints")
"""Fields of one number a joint that may be missing."""
TEXTS = ("object", "object_sha256", "split", "provenance")
"""Fields of one string a grasp."""
REQUIRED = ("object", "wrist_position", "wrist_quaternion_wxyz", "joints")
"""Columns without which a file holds no grasps."""
HEADER = ("hand", "hand_sha256", "wrist_link", "joint_names")
"""Entries of the file's header."""
UNTRIED = ""
"""Protocol of a grasp that no trial has tried."""


def encode(batch: Any) -> tuple[dict[str, pa.Array], dict[str, Any]]:
    """Columns and header of a GraspBatch's file."""
    xyzw = roma.rotmat_to_unitquat(batch.T_object_wrist[:, :3, :3].to(torch.float64))
    columns: dict[str, pa.Array] = {
        "object": pa.array(list(batch.object), pa.string()),
        "wrist_position": fixed_column(batch.T_object_wrist[:, :3, 3]),
        "wrist_quaternion_wxyz": fixed_column(roma.quat_xyzw_to_wxyz(xyzw)),
        "joints": float_column(batch.joints),
    }
    nothing = torch.full((len(batch),), torch.nan)
    for name in (*LISTS, *FLOATS):
        value = getattr(batch, name)
        wide = nothing[:, None].expand(-1, len(batch.joint_names)) if name in LISTS else nothing
        columns[name] = float_column(wide if value is None else value)
    success = torch.zeros(len(batch), dtype=torch.bool) if batch.success is None else batch.success
    columns["success"] = pa.array(success.cpu().numpy(), mask=(~batch.tried).numpy())
    protocol = [p or None for p in batch.protocol] if batch.protocol else [None] * len(batch)
    columns["protocol"] = pa.array(protocol, pa.string())
    for name in TEXTS[1:]:
        columns[name] = pa.array(list(getattr(batch, name)), pa.string())
    columns["seed"] = pa.array(batch.seed.cpu().numpy())
    columns |= {name: _extra_column(value) for name, value in batch.extra.items()}
    header = {"hand": batch.hand, "hand_sha256": batch.hand_sha256, "wrist_link": batch.wrist_link,
              "joint_names": list(batch.joint_names)}
    return columns, header


def _extra_column(value: Any) -> pa.Array:
    if isinstance(value, Tensor):
        return float_column(value) if value.is_floating_point() else pa.array(value.cpu().numpy().tolist())
    return pa.array(list(value))


def decode(table: pa.Table, header: dict[str, Any], path: str) -> dict[str, Any]:
    """Constructor arguments of a GraspBatch from a grasp file's table and header.

    Raises:
        GraspFileError: Columns or header entries are missing, or poses are not finite.
    """
    missing = [name for name in REQUIRED if name not in table.column_names]
    lacking = [key for key in HEADER if key not in header]
    if missing or lacking:
        raise GraspFileError(f"{path} lacks columns {missing} and header entries {lacking} of a grasp file")
    n, n_dof = table.num_rows, len(header["joint_names"])

    def text(name: str) -> tuple[str, ...]:
        return tuple(v or "" for v in table[name].to_pylist()) if name in table.column_names else ("",) * n

    def numbers(name: str, width: int | None) -> Tensor | None:
        if name not in table.column_names or table[name].null_count == n:
            return None
        return floats(table[name], width, f"{path}, column {name}")

    position, quaternion, joints = (
        floats(table[name], width, f"{path}, column {name}")
        for name, width in (("wrist_position", 3), ("wrist_quaternion_wxyz", 4), ("joints", n_dof))
    )
    length = quaternion.norm(dim=-1, keepdim=True)
    if not (position.isfinite().all() and joints.isfinite().all() and ((length - 1).abs() < 1e-2).all()):
        raise GraspFileError(f"{path} has grasps with missing or non-finite poses; write it without them")
    T = torch.eye(4).repeat(n, 1, 1)
    T[:, :3, :3] = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(quaternion / length))
    T[:, :3, 3] = position
    success = table["success"].to_pylist() if "success" in table.column_names else [None] * n
    tried = any(s is not None for s in success)
    protocol = tuple(
        (p or "unknown") if s is not None else UNTRIED for p, s in zip(text("protocol"), success, strict=True)
    )
    known = {*FLOATS, *LISTS, *TEXTS, *REQUIRED, "seed", "success", "protocol"}
    seed = [s or 0 for s in table["seed"].to_pylist()] if "seed" in table.column_names else [0] * n
    return {
        "T_object_wrist": T, "joints": joints,
        "hand": header["hand"], "hand_sha256": header["hand_sha256"], "wrist_link": header["wrist_link"],
        "joint_names": tuple(header["joint_names"]), "seed": torch.tensor(seed, dtype=torch.int64),
        **{name: text(name) for name in TEXTS},
        **{name: numbers(name, n_dof) for name in LISTS}, **{name: numbers(name, None) for name in FLOATS},
        "success": torch.tensor([bool(s) for s in success]) if tried else None,
        "protocol": protocol if tried else None,
        "extra": {name: _decode_extra(table[name]) for name in table.column_names if name not in known},
    }


def _decode_extra(column: pa.ChunkedArray) -> Any:
    kind = column.type
    if pa.types.is_floating(kind):
        return floats(column, None, "extra")
    if column.null_count == 0 and (pa.types.is_boolean(kind) or pa.types.is_integer(kind)):
        return torch.tensor(column.to_pylist())
    if pa.types.is_list(kind) and pa.types.is_floating(kind.value_type):
        lengths = {len(v) for v in column.to_pylist() if v is not None}
        if len(lengths) == 1:
            return floats(column, lengths.pop(), "extra")
    return column.to_pylist()
