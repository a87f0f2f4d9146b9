"""Grasp files: what their columns and header must be, Parquet in and out, and a GraspBatch from and to them."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Bool, Float, Int, Num, Shaped
from torch import Tensor

from dro_grasp.errors import GraspFileError
from dro_grasp.files import given_path, reading
from dro_grasp.geometry import se3
from dro_grasp.geometry.se3 import roma
from dro_grasp.grasps import columns
from dro_grasp.grasps.columns import CAMERA, FRAME, HAND_FILE, OBJECT_CLOUD, OBJECT_FILE, OBJECT_MASS, OBJECT_SCALE

HEADER = {"hand": "a name", "hand_sha256": "a hash, or ''", "wrist_link": "a name"}  # Texts of the header
JOINTS = "joint_names"  # Entry of the header with the names of the joints
ASKED = "asked"  # Entry of the header with how many grasps of each object were asked for; files that do not know it lack it
ASKED_OF = ("object", "object_sha256", "num")  # What it states of each
NOTES = "notes"  # Entry of the header with plain values about the making, or null


def _is_text(kind: pa.DataType) -> bool:
    if pa.types.is_dictionary(kind):
        return _is_text(kind.value_type)
    return pa.types.is_string(kind) or pa.types.is_large_string(kind)


def _is_number(kind: pa.DataType) -> bool:
    return pa.types.is_floating(kind) or pa.types.is_integer(kind)


def _is_list_of(test: Callable[[pa.DataType], bool]) -> Callable[[pa.DataType], bool]:
    def check(kind: pa.DataType) -> bool:
        lists = pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind) or pa.types.is_large_list(kind)
        return lists and test(kind.value_type)
    return check


KINDS: tuple[tuple[str, Callable[[pa.DataType], bool], tuple[str, ...]], ...] = (
    ("texts", _is_text,
     (*columns.TEXTS, "protocol", columns.REASON, columns.FAILURE, HAND_FILE, OBJECT_CLOUD, OBJECT_FILE, FRAME)),
    ("numbers", _is_number, (*columns.FLOATS, OBJECT_SCALE, OBJECT_MASS)),
    ("whole numbers", pa.types.is_integer, ("seed",)),
    ("truth values", pa.types.is_boolean, ("success",)),
    ("lists of numbers", _is_list_of(_is_number),
     ("joints", "wrist_position", "wrist_quaternion_wxyz", *columns.PER_JOINT, CAMERA)),
    ("lists of texts", _is_list_of(_is_text), (columns.CONTACT_LINKS,)),
)
"""What columns hold, in words and as a test of their type, and which columns do; all may be null."""


def check_header(header: dict[str, Any], path: object) -> None:
    """Refuse a header whose entries are missing or of another type: GraspFileError."""
    expected = {name: (isinstance(header.get(name), str), what) for name, what in HEADER.items()}
    names, notes = header.get(JOINTS), header.get(NOTES)
    named = isinstance(names, list) and all(isinstance(name, str) for name in names) and len(set(names)) == len(names) > 0
    expected[ASKED] = _is_asked(header.get(ASKED, [])), "a list of objects with a name, a hash and a number"
    expected |= {JOINTS: (named, "a list of different names"), NOTES: (notes is None or isinstance(notes, dict), "an object")}
    for name, (fits, what) in expected.items():
        if not fits:
            raise GraspFileError(f"{path}: the header's '{name}' is {str(header.get(name))[:60]}, expected {what}; write the "
                                 "file again")


def _is_asked(entry: Any) -> bool:
    """Whether an entry states how many grasps of each object were asked for."""
    return isinstance(entry, list) and all(
        isinstance(one, dict) and set(one) >= set(ASKED_OF) and isinstance(one["object"], str)
        and isinstance(one["object_sha256"], str) and type(one["num"]) is int and one["num"] >= 0 for one in entry)


def check_columns(schema: pa.Schema, path: object) -> None:
    """Refuse columns that occur twice, or hold something else than their name says: GraspFileError."""
    if twice := [name for name in schema.names if schema.names.count(name) > 1]:
        raise GraspFileError(f"{path} has two columns '{twice[0]}'; write the file again")
    for what, fits, names in KINDS:
        for name in names:
            kind = schema.field(name).type if name in schema.names else pa.null()
            if not (pa.types.is_null(kind) or fits(kind)):
                raise GraspFileError(f"{path}: column '{name}' holds {kind}, expected {what}; write the file again")
    if FRAME in schema.names and CAMERA not in schema.names:
        raise GraspFileError(f"{path} names the frame of its grasps in '{FRAME}', and lacks the column '{CAMERA}' with the "
                             "camera's pose in it; write the file again")


FORMAT_VERSION = 1  # Version of the grasp file that this code writes and reads
METADATA_KEY = b"dro_grasp"  # Key of the JSON header in the schema metadata
EXPECTED = "a Parquet file that dro-grasp wrote, whole; write it again"  # A grasp file, for messages (ours)


def table_bytes(columns: dict[str, pa.Array | pa.ChunkedArray], header: dict[str, Any]) -> bytes:
    """A grasp file of Arrow arrays of equal length by name; the format version is added to the header."""
    metadata = {METADATA_KEY: json.dumps({"format_version": FORMAT_VERSION, **header}).encode()}
    table, file = pa.table(columns).replace_schema_metadata(metadata), io.BytesIO()
    # Byte-stream split puts bytes of equal weight side by side: rounded floats then take half the space.
    split = [path for path, kind in _leaves(table.schema) if pa.types.is_floating(kind)]
    texts = [path for path, kind in _leaves(table.schema) if not pa.types.is_floating(kind)]
    pq.write_table(
        table, file, compression="zstd", compression_level=9,
        use_dictionary=texts, use_byte_stream_split=split,  # type: ignore[arg-type]  # the stubs know bool alone
    )
    return file.getvalue()


def _leaves(schema: pa.Schema) -> list[tuple[str, pa.DataType]]:
    """Parquet path and type of every column, lists by their elements."""
    lists = (pa.types.is_list, pa.types.is_fixed_size_list)
    return [
        (f"{f.name}.list.element", f.type.value_type) if any(test(f.type) for test in lists) else (f.name, f.type)
        for f in schema
    ]


def read_table(path: Path | str | io.BytesIO) -> tuple[pa.Table, dict[str, Any]]:
    """A grasp file's table and header; GraspFileError: it is missing, truncated, foreign, or of another version."""
    path = _existing(path)
    with reading(path, GraspFileError, EXPECTED, pa.ArrowException):
        table = read_parquet(path)
        header = read_header(path, table.schema)
        check_columns(table.schema, path)
    return table, header


def read_parquet(source: Path | io.BytesIO) -> pa.Table:
    """The table of a file, opened once, so that it is whole where a run replaces the file meanwhile."""
    with pq.ParquetFile(source) as file:
        return file.read()


def read_footer(path: Path | str) -> tuple[int, dict[str, Any]]:
    """Number of grasps in a grasp file, and its header, from the footer alone; errors are those of `read_table`."""
    found = _existing(path)
    with reading(found, GraspFileError, EXPECTED, pa.ArrowException):
        footer = pq.read_metadata(found)
        return footer.num_rows, read_header(found, footer.schema.to_arrow_schema())


def _existing(path: Path | str | io.BytesIO) -> Path | io.BytesIO:
    if isinstance(path, io.BytesIO):
        return path
    path = given_path(path)
    if not path.is_file():
        raise GraspFileError(f"no grasp file {path}; give the path of a .parquet file that dro-grasp wrote")
    return path


def read_header(path: Path | str | io.BytesIO, schema: pa.Schema) -> dict[str, Any]:
    """The JSON header of a grasp file's schema; GraspFileError: it is missing, garbled or of another version."""
    raw = (schema.metadata or {}).get(METADATA_KEY)
    if raw is None:
        raise GraspFileError(f"{path} is Parquet, but no grasp file: its schema has no 'dro_grasp' metadata")
    with reading(path, GraspFileError, "a 'dro_grasp' header, which is garbled; write the file again"):
        header = json.loads(raw)
        if not isinstance(header, dict):
            raise ValueError(f"it holds a {type(header).__name__}")
        version = header["format_version"]
    if version != FORMAT_VERSION:
        raise GraspFileError(
            f"{path} has grasp file version {version}, this dro-grasp reads version {FORMAT_VERSION}; "
            "install the release that wrote it, or write the file again"
        )
    check_header(header, path)
    return header


def float_column(values: Float[Tensor, "n *k"]) -> pa.Array:
    """A float tensor (n) or (n k) as a column; rows with NaN become null."""
    array = values.detach().cpu().to(torch.float32).numpy()
    if array.ndim == 1:
        return plain_column(array, np.isnan(array))
    ends = np.arange(1, len(array) + 1) * array.shape[1]
    return list_column(ends, plain_column(array.ravel()), np.asarray(np.isnan(array).any(1)))


def plain_column(values: Num[np.ndarray, " n"], missing: Bool[np.ndarray, " n"] | None = None) -> pa.Array:
    """Numbers as a column; those that are missing become null.

    Columns are put together from buffers: `pa.array` would import pandas, where that is installed, which takes longer than all
    else that is done to a file.
    """
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [_present(missing), _buffer(values)])


def truth_column(values: Bool[np.ndarray, " n"], missing: Bool[np.ndarray, " n"]) -> pa.Array:
    """Truth values as a column; those that are missing become null."""
    return pa.Array.from_buffers(pa.bool_(), len(values), [_present(missing), _bits(values)])


def text_column(values: Sequence[str | None]) -> pa.Array:
    """Texts as a column; None becomes null."""
    encoded = [(value or "").encode() for value in values]
    missing = np.array([value is None for value in values], bool)
    buffers = [_present(missing), _offsets(np.cumsum([len(text) for text in encoded])), pa.py_buffer(b"".join(encoded))]
    return pa.Array.from_buffers(pa.string(), len(encoded), buffers)


def list_column(ends: Int[np.ndarray, " n"], elements: pa.Array, missing: Bool[np.ndarray, " n"]) -> pa.Array:
    """Lists, of which each ends where `ends` says among all their elements, as a column."""
    buffers = [_present(missing), _offsets(ends)]
    return pa.Array.from_buffers(pa.list_(elements.type), len(ends), buffers, children=[elements])


def _present(missing: Bool[np.ndarray, " n"] | None) -> pa.Buffer | None:
    return None if missing is None or not missing.any() else _bits(~missing)


def _bits(values: Bool[np.ndarray, " n"]) -> pa.Buffer:
    return _buffer(np.packbits(values, bitorder="little"))


def _offsets(ends: Num[np.ndarray, " n"]) -> pa.Buffer:
    return _buffer(np.concatenate([[0], ends]).astype(np.int32))


def _buffer(values: Shaped[np.ndarray, " n"]) -> pa.Buffer:
    return pa.py_buffer(np.ascontiguousarray(values))


def fixed_column(values: Float[Tensor, "n k"]) -> pa.Array:
    """A float tensor (n k) without missing rows as a column of fixed-size lists."""
    array = np.ascontiguousarray(values.detach().cpu().to(torch.float32).numpy())
    return pa.FixedSizeListArray.from_arrays(plain_column(array.ravel()), array.shape[1])


def floats(column: pa.ChunkedArray, width: int | None, where: str) -> Float[Tensor, "n *width"]:
    """The inverse of `float_column` and `fixed_column`; GraspFileError: no numbers, or lists of another length than `width`."""
    array = column.combine_chunks()
    try:
        if width is None:
            return torch.from_numpy(_numbers(array))
        result = np.full((len(array), width), np.nan, np.float32)
        present = ~np.array(array.is_null())
        flat = _numbers(array.drop_null().flatten())
        lengths = np.array(array.drop_null().value_lengths()) if present.any() else np.zeros(0, int)
        if not (lengths == width).all():
            raise GraspFileError(f"{where}: lists of length {set(lengths.tolist())}, expected {width}")
        result[present] = flat.reshape(-1, width)
    except (pa.ArrowException, AttributeError, ValueError) as error:
        raise GraspFileError(f"{where}: expected numbers, found {array.type} ({error})") from error
    return torch.from_numpy(result)


def _numbers(array: pa.Array) -> Float[np.ndarray, " n"]:
    return np.array(array.cast(pa.float32()).to_numpy(zero_copy_only=False), np.float32)


REQUIRED = ("object", "wrist_position", "wrist_quaternion_wxyz", "joints")  # Columns without which a file holds no grasps
TEXTS = {columns.REASON, columns.FAILURE}
"""Further columns of the trial that hold texts, which their values do not tell when all are unknown."""
SYNTHESIZED = re.compile(r"\bsynthesis \d+\b")
"""Provenance of synthesized grasps, whose `score` is minus the energy in files without a column `energy`."""


def encode(batch: Any) -> tuple[dict[str, pa.Array], dict[str, Any]]:
    """Columns and header of a GraspBatch's file; GraspFileError: no file could state its protocols."""
    if (fault := columns.protocol_fault(batch.protocol)) is not None:
        raise GraspFileError(f"{fault}; name it so before the grasps are saved")
    stored: dict[str, pa.Array] = {
        "object": text_column(batch.object),
        "wrist_position": fixed_column(batch.T_object_wrist[:, :3, 3]),
        "wrist_quaternion_wxyz": fixed_column(batch.wrist_quaternion_wxyz),
        "joints": float_column(batch.joints),
    }
    stored |= {name: float_column(getattr(batch, name)) for name in (*columns.PER_JOINT, *columns.FLOATS)}
    stored["success"] = truth_column(batch.trial_success.cpu().numpy(), (~batch.evaluated).cpu().numpy())
    stored["protocol"] = text_column([p or None for p in batch.protocol])
    stored |= {name: text_column(getattr(batch, name)) for name in columns.TEXTS[1:]}
    stored["seed"] = plain_column(batch.seed.cpu().numpy())
    stored |= {name: _further_column(name, value) for name, value in batch.extra.items()}
    check_columns(pa.schema([(name, column.type) for name, column in stored.items()]), "what is to be saved")
    header = {"hand": batch.hand, "hand_sha256": batch.hand_sha256, "wrist_link": batch.wrist_link,
              "joint_names": list(batch.joint_names)}
    if batch.asked_of:
        header[ASKED] = [dict(zip(ASKED_OF, (*key, num), strict=True)) for key, num in batch.asked_of.items()]
    return stored, header


def _further_column(name: str, value: Any) -> pa.Array:
    if isinstance(value, Tensor):
        return float_column(value) if value.is_floating_point() else pa.array(value.cpu().numpy().tolist())
    if name == columns.CONTACT_LINKS:
        links = [() if own is None else own for own in value]
        missing = np.array([own is None for own in value], bool)
        names = text_column([link for own in links for link in own])
        return list_column(np.cumsum([len(own) for own in links], dtype=np.int64), names, missing)
    if name in TEXTS or (value and all(isinstance(one, str) for one in value)):
        return text_column(value)
    return pa.array(list(value))


def decode(table: pa.Table, header: dict[str, Any], path: str) -> dict[str, Any]:
    """Constructor arguments of a GraspBatch; GraspFileError: columns are missing, or poses are not finite."""
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
    if (fault := columns.protocol_fault(protocol)) is not None:
        raise GraspFileError(f"{path}: {fault}; evaluate its grasps again, or write the file again")
    fields: dict[str, Any] = {name: text(name) for name in columns.TEXTS}
    fields |= {name: numbers(name, n_dof) for name in columns.PER_JOINT}
    fields |= {name: numbers(name, None) for name in columns.FLOATS}
    if "energy" not in table.column_names:
        fields |= _energy_apart(fields["score"], fields["provenance"], table)
    known = {*columns.COLUMNS, *REQUIRED, "success"}
    extra = {name: _decode_further(table[name]) for name in table.column_names if name not in known}
    for name in (OBJECT_SCALE, OBJECT_MASS):
        if not isinstance(extra.get(name), Tensor):  # null for every grasp
            extra.pop(name, None)
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
    """Energy and score in a file without a column `energy`: the score of its synthesized grasps is minus the energy."""
    terms = [name for name in table.column_names if name.startswith(columns.ENERGY_TERM)]
    has_terms = ~torch.from_numpy(np.array(table[terms[0]].is_null())) if terms else torch.zeros(len(score), dtype=torch.bool)
    synthesized = has_terms & torch.tensor([SYNTHESIZED.search(p) is not None for p in provenance], dtype=torch.bool)
    nothing = torch.full_like(score, torch.nan)
    return {"energy": torch.where(synthesized, -score, nothing), "score": torch.where(synthesized, nothing, score)}


def _decode_further(column: pa.ChunkedArray) -> Any:
    kind = column.type
    if pa.types.is_floating(kind):
        return floats(column, None, "extra")
    if column.null_count == 0 and (pa.types.is_boolean(kind) or pa.types.is_integer(kind)):
        return torch.tensor(column.to_pylist())
    lists = pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
    if lists and pa.types.is_floating(kind.value_type):
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
