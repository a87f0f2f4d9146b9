"""Merge data sets: near-duplicates once, an even choice of grasps for each pair, compact files of limited size."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count, takewhile
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.files import check_output, replacing
from dro_grasp.geometry.se3 import compose, roma
from dro_grasp.grasps.batch import GraspBatch, distinct
from dro_grasp.grasps.columns import CAMERA, CARRYING, FAILURE, OBJECT_MASS, OBJECT_SCALE, POSTURES, REASON
from dro_grasp.grasps.grasp_file import encode, table_bytes
from dro_grasp.grasps.sources import hand_of
from dro_grasp.hands.hand import Hand
from dro_grasp.training.data.collections.collection import read_collection, yield_notes
from dro_grasp.training.data.engine.shards import Yield, find_shards

POSITION_STEP = 2.0**-16  # Grid of positions in merged files [m]. Ours: 0.015 mm
ANGLE_STEP = 2.0**-13  # Grid of joints, pregrasps and squeezes in merged files [rad or m]. Ours: 0.12 mrad
UNIT_STEP = 2.0**-15  # Grid of quaternions in merged files. Ours: 0.03 mrad
MANTISSA = 10
"""Bits of the mantissa of scores, energies, distances and angles of trials, and further columns. Ours: three digits."""
FILE_BYTES = 100_000_000  # Size of a merged file from which on the next object goes into another [bytes] (ours)
ASIDE = ".merge-"  # How the names of folders begin in which grasps wait
PLAIN_COLUMNS = (REASON, FAILURE)  # Columns that are empty for successes
EXACT = (OBJECT_SCALE, OBJECT_MASS, CAMERA)  # Further columns without which the object is not found again


@dataclass(frozen=True)
class Merged:
    """Grasps of one hand out of several data sets, for one file."""

    hand: str
    table: pa.Table  # the grasps as columns of their file, which take a fifth of the memory
    header: dict[str, Any]
    yields: dict[str, Yield]  # by object
    duplicates: int  # near-duplicates that were dropped
    surplus: int  # grasps above the number asked for, dropped
    number: int = 1  # of the file, where the hand's grasps fill several

    def __len__(self) -> int:
        return self.table.num_rows

    def to_bytes(self) -> bytes:
        """The grasp file, with the yields in its notes."""
        columns = {name: self.table[name] for name in self.table.column_names}
        return table_bytes(columns, self.header | {"notes": yield_notes(self.yields)})

    def save(self, path: Path) -> None:
        """Write the grasp file."""
        with replacing(check_output(path)) as temporary:
            temporary.write_bytes(self.to_bytes())


class Waiting(NamedTuple):
    """Grasps of a pair from one data set, in a file of their own until those of all data sets are known."""

    file: Path
    made: Yield


def merge(
    paths: Sequence[Path | str], per_pair: int | None = None, aside: Path | None = None, file_bytes: int = FILE_BYTES
) -> Iterator[Merged]:
    """Merge data sets, hand by hand and object by object; memory holds the grasps of one file.

    Args:
        paths: As in `read_collection`.
        per_pair: Most grasps of a pair; the choice spreads best over palm directions.
        aside: Folder in which the grasps wait meanwhile, as much again as the data sets; by default the system's for
            temporary files.
        file_bytes: Size of a file from which on the next object goes into another, about.
    """
    require_choice(per_pair)
    with tempfile.TemporaryDirectory(dir=aside, prefix=ASIDE) as name:
        for hand, pairs in sorted(_by_pair(paths, Path(name)).items()):
            yield from _merge_hand(hand, pairs, per_pair, file_bytes)


def require_choice(per_pair: int | None) -> None:
    """Refuse a number of grasps of a pair with which none would be left."""
    if per_pair is not None and per_pair < 1:
        raise OptionError(f"per_pair is {per_pair}; give at least 1, or leave it out to keep all grasps (per_pair=...)")


def file_name(hand: str, number: int = 1) -> str:
    """Name of a merged file: the hand's with its source, as hands of two sources may share a name."""
    return f"{hand.replace('/', '-')}{'' if number == 1 else f'.{number}'}.parquet"


def require_no_shards(folder: Path) -> None:
    """Refuse a folder with a file for each pair, which merged files would hide: OptionError."""
    if folder.is_dir() and find_shards(folder):
        raise OptionError(f"{folder} holds grasps of another command, pair by pair; give a folder of its own to what is merged "
                          "(output=...)")


def remove_further(folder: Path, hand: str, number: int) -> None:
    """Remove what an earlier merge left of a hand in a folder: files with higher numbers than those written."""
    for path in takewhile(Path.exists, (folder / file_name(hand, further) for further in count(number + 1))):
        path.unlink()


def _by_pair(paths: Sequence[Path | str], folder: Path) -> dict[str, dict[str, list[Waiting]]]:
    """The grasps of all data sets by hand and object, in files."""
    pairs: dict[str, dict[str, list[Waiting]]] = {}
    versions: dict[tuple[str, str], set[str]] = {}
    for place, (source, pair) in enumerate((path, pair) for path in paths for pair in read_collection(path)):
        grasps = pair.grasps
        # The pair may have been requested by path.
        name = grasps.object[0] if len(grasps) else pair.object
        for what, new in ((("hand", grasps.hand), {grasps.hand_sha256}),
                          (("object", f"{name} of {grasps.hand}"), set(grasps.object_sha256))):
            known = versions.setdefault(what, set())
            known |= new
            if len(known) > 1:
                kind, own = what[0], grasps.hand if what[0] == "hand" else name
                hashes = ", ".join(sha256[:12] or "unknown" for sha256 in sorted(known))
                raise GraspFileError(f"{kind} '{own}' in {source} is not the same everywhere in the data sets (hashes "
                                     f"{hashes}): another {kind} of this name, or another version of it. Merge them apart, or "
                                     "rename one file and make its grasps again")
        file = folder / f"{place}.parquet"
        grasps.save(file)
        pairs.setdefault(grasps.hand, {}).setdefault(name, []).append(Waiting(file, pair.made))
    return pairs


def _merge_hand(name: str, pairs: dict[str, list[Waiting]], per_pair: int | None, file_bytes: int) -> Iterator[Merged]:
    hand, row_bytes, most, number = None, 0.0, 0, 1
    kept: list[pa.Table] = []
    header: dict[str, Any] = {}
    yields, duplicates, surplus = {}, 0, 0
    for obj, group in sorted(pairs.items()):
        grasps = GraspBatch.concatenate([GraspBatch.load(waiting.file) for waiting in group])
        for waiting in group:
            waiting.file.unlink()
        new = chosen = grasps
        if len(grasps):  # without one, the hand's file is not known yet
            hand = hand or hand_of(grasps, None)
            new = grasps[distinct(hand, grasps)] if len(group) > 1 else grasps
            chosen = compact(hand, new if per_pair is None else new[spread(hand, new, per_pair)])
        columns, header = encode(chosen)
        kept.append(pa.table(columns))
        yields[obj] = sum((waiting.made for waiting in group), Yield())
        duplicates, surplus = duplicates + len(grasps) - len(new), surplus + len(new) - len(chosen)
        if len(chosen) > most:  # in small ones, the header counts for each grasp
            row_bytes, most = len(table_bytes(columns, header)) / len(chosen), len(chosen)
        if row_bytes * sum(table.num_rows for table in kept) >= file_bytes:
            yield Merged(name, _joined(kept), header, yields, duplicates, surplus, number)
            kept, yields, duplicates, surplus, number = [], {}, 0, 0, number + 1
    if kept:
        yield Merged(name, _joined(kept), header, yields, duplicates, surplus, number)


def _joined(tables: Sequence[pa.Table]) -> pa.Table:
    return pa.concat_tables(tables, promote_options="permissive")  # columns that some lack are unknown for their grasps


def spread(hand: Hand, grasps: GraspBatch, count: int) -> Int[Tensor, " k"]:
    """Indices of at most `count` grasps whose palm directions cover the sphere best, in their order.

    Farthest-first: the choice starts with the first grasp and adds the one whose palm direction is farthest from all
    chosen ones.
    """
    require_choice(count)
    if len(grasps) <= count:
        return torch.arange(len(grasps))
    directions = hand.palm_directions(grasps.T_object_wrist)
    chosen = [0]
    nearest = 1 - directions @ directions[0]
    for _ in range(count - 1):
        nearest[chosen[-1]] = -1.0
        chosen.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, 1 - directions @ directions[chosen[-1]])
    return torch.tensor(sorted(chosen))


def compact(hand: Hand, grasps: GraspBatch) -> GraspBatch:
    """The grasps with rounded numbers, so that files compress; joints stay within their limits, counts and shares exact."""
    quaternion = _on_grid(roma.rotmat_to_unitquat(grasps.T_object_wrist[:, :3, :3]), UNIT_STEP)
    rotation = roma.unitquat_to_rotmat(quaternion / quaternion.norm(dim=-1, keepdim=True))
    T = compose(rotation, _on_grid(grasps.T_object_wrist[:, :3, 3], POSITION_STEP))
    lower, upper = hand.tree.lower, hand.tree.upper
    joints = _on_grid(grasps.joints, ANGLE_STEP).clamp(lower, upper)
    postures = {}
    for name in POSTURES:  # targets may lie beyond the limits
        given = getattr(grasps, name)
        postures[name] = _on_grid(given, ANGLE_STEP).clamp(torch.minimum(given, lower), torch.maximum(given, upper))
    extra = {
        name: _short(value) if isinstance(value, Tensor) and value.is_floating_point() and name not in EXACT else value
        for name, value in grasps.extra.items() if name not in PLAIN_COLUMNS
    }
    rounded = "score", "energy", "displacement", "rotation", "penetration", *CARRYING, "squeeze_torque"
    short = {name: _short(getattr(grasps, name)) for name in rounded}
    return grasps.replace(T_object_wrist=T, joints=joints, extra=extra, **postures, **short)


def _on_grid(values: Float[Tensor, "*n"], step: float) -> Float[Tensor, "*n"]:
    return (values / step).round() * step


def _short(values: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Values with MANTISSA bits."""
    mantissa, exponent = torch.frexp(values)
    return torch.ldexp((mantissa * 2**MANTISSA).round() / 2**MANTISSA, exponent)
