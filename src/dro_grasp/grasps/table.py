"""Grasp files as tables: Parquet in and out, with errors that name the file.

This module knows columns and metadata; `codec` knows their meaning.
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import GraspFileError
from dro_grasp.files import given_path, reading
from dro_grasp.grasps.schema import check_columns, check_header

FORMAT_VERSION = 1
"""Version of the grasp file that this code writes and reads."""
METADATA_KEY = b"dro_grasp"
"""Key of the JSON header in the schema metadata."""
EXPECTED = "a Parquet file that dro-grasp wrote, whole; write it again"
"""A grasp file, for messages (ours)."""


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
    """Read a grasp file's table and header.

    Raises:
        GraspFileError: No such file, a truncated or foreign one, or one of another version.
    """
    with reading(path, GraspFileError, EXPECTED, pa.ArrowException):
        table = pq.read_table(_existing(path))
        header = read_header(path, table.schema)
        check_columns(table.schema, path)
    return table, header


def read_footer(path: Path | str) -> tuple[int, dict[str, Any]]:
    """Number of grasps in a grasp file, and its header, from the footer alone.

    Raises:
        GraspFileError: As `read_table`.
    """
    with reading(path, GraspFileError, EXPECTED, pa.ArrowException):
        footer = pq.read_metadata(_existing(path))
        return footer.num_rows, read_header(path, footer.schema.to_arrow_schema())


def _existing(path: Path | str | io.BytesIO) -> Path | io.BytesIO:
    if isinstance(path, io.BytesIO):
        return path
    path = given_path(path)
    if not path.is_file():
        raise GraspFileError(f"no grasp file {path}; give the path of a .parquet file that dro-grasp wrote")
    return path


def read_header(path: Path | str | io.BytesIO, schema: pa.Schema) -> dict[str, Any]:
    """The JSON header of a grasp file's schema.

    Raises:
        GraspFileError: The header is missing, garbled or of another version.
    """
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
    missing = np.isnan(array) if array.ndim == 1 else np.isnan(array).any(1)
    if array.ndim == 1:
        return pa.array(array, mask=missing)
    offsets = np.arange(len(array) + 1, dtype=np.int32) * array.shape[1]
    flat = pa.array(np.ascontiguousarray(array).ravel())
    return pa.ListArray.from_arrays(pa.array(offsets), flat, mask=pa.array(missing))


def fixed_column(values: Float[Tensor, "n k"]) -> pa.Array:
    """A float tensor (n k) without missing rows as a column of fixed-size lists."""
    array = np.ascontiguousarray(values.detach().cpu().to(torch.float32).numpy())
    return pa.FixedSizeListArray.from_arrays(pa.array(array.ravel()), array.shape[1])


def floats(column: pa.ChunkedArray, width: int | None, where: str) -> Float[Tensor, "n *width"]:
    """The inverse of `float_column` and `fixed_column`; null becomes NaN.

    Args:
        column: Numbers (width None) or lists of numbers.
        width: Expected length of each list.
        where: File and column, for the message.

    Raises:
        GraspFileError: A list has another length, or the column does not hold numbers.
    """
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
