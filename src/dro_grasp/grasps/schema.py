"""What a grasp file's header and columns must be, checked once for every reader."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pyarrow as pa

from dro_grasp.errors import GraspFileError
from dro_grasp.grasps import columns
from dro_grasp.grasps.columns import CAMERA, FRAME, HAND_FILE, OBJECT_FILE, OBJECT_SCALE

HEADER = {"hand": "a name", "hand_sha256": "a hash, or ''", "wrist_link": "a name"}
"""Texts of the header."""
JOINTS = "joint_names"
"""Entry of the header with the names of the joints."""
ASKED = "asked"
"""Entry of the header with how many grasps of each object were asked for; files that do not know it lack it."""
ASKED_OF = ("object", "object_sha256", "num")
"""What it states of each."""
NOTES = "notes"
"""Entry of the header with plain values about the making, or null."""


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
    ("texts", _is_text, (*columns.TEXTS, "protocol", columns.REASON, columns.FAILURE, HAND_FILE, OBJECT_FILE, FRAME)),
    ("numbers", _is_number, (*columns.FLOATS, OBJECT_SCALE)),
    ("whole numbers", pa.types.is_integer, ("seed",)),
    ("truth values", pa.types.is_boolean, ("success",)),
    ("lists of numbers", _is_list_of(_is_number),
     ("joints", "wrist_position", "wrist_quaternion_wxyz", *columns.POSTURES, CAMERA)),
    ("lists of texts", _is_list_of(_is_text), (columns.CONTACT_LINKS,)),
)
"""What columns hold, in words and as a test of their type, and which columns do; all may be null."""


def check_header(header: dict[str, Any], path: object) -> None:
    """Refuse a header whose entries are missing or of another type.

    Raises:
        GraspFileError: As said; it names the entry.
    """
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
    """Refuse columns that occur twice, or hold something else than their name says.

    Raises:
        GraspFileError: As said; it names the column.
    """
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
