"""Import grasps of other projects: the official CMapDataset, DexGraspNet and DexGraspBench.

Their files are pickles, which can run code; these readers build numbers, names and arrays only. Sources: the loaders of
the official D(R,O) release (roll, pitch and yaw about moving axes), DexGraspNet's description of its data (about fixed
axes), the readme of DexGraspBench.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Shaped
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from dro_grasp.errors import GraspFileError, ObjectError, OptionError
from dro_grasp.files import UNTYPED, given_path, reading
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import with_sources
from dro_grasp.hands.library import load_hand, locate_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.training.data.engine.schedule import require_distinct_names

Format = Literal["cmap", "dexgraspnet", "dexgraspbench"]
WRIST = ("WRJTx", "WRJTy", "WRJTz", "WRJRx", "WRJRy", "WRJRz")  # Names of the wrist's six coordinates. Source: DexGraspNet
HARMLESS = {
    ("numpy.core.multiarray", "_reconstruct"), ("numpy._core.multiarray", "_reconstruct"), ("numpy", "ndarray"),
    ("numpy", "dtype"), ("numpy.core.multiarray", "scalar"), ("numpy._core.multiarray", "scalar"),
    ("collections", "OrderedDict"),
}
"""Classes that a pickle may name. Source: the pickles that NumPy writes."""
EXPECTED = {
    "cmap": "'metadata', a list of (wrist and joints, object, hand)",
    "dexgraspnet": "a list of grasps, each with 'scale' and 'qpos', and in that WRJTx to WRJRz and the joints",
    "dexgraspbench": "'grasp_qpos', and where it applies 'joint_names', 'obj_pose', 'obj_scale', 'obj_path' and 'hand'",
}
"""Entries of each format, for messages."""


Joints = dict[str, float] | Float[np.ndarray, " n_joints"]  # Values by name, or in the order of the hand's moving joints


@dataclass(frozen=True)
class ForeignGrasp:
    """One grasp in a file's own terms."""

    hand: str  # empty if the format names none; so is `object`
    object: str
    scale: float  # of the object
    T_object_wrist: Float[np.ndarray, "4 4"]
    joints: Joints  # [rad or m]
    pregrasp: Joints | None = None
    """Joints from which the hand closes, if the format has them, in this wrist pose too [rad or m]."""
    squeeze: Joints | None = None  # joint targets that press on the object, likewise


def read_foreign(path: Path, kind: Format) -> list[ForeignGrasp]:
    """All grasps of a project's file: `cmap_dataset.pt`, or an npy file."""
    readers = {"cmap": _cmap, "dexgraspnet": _dexgraspnet, "dexgraspbench": _dexgraspbench}
    path = given_path(path)
    if path.is_dir():
        raise GraspFileError(f"{path} is a folder; name the {kind} files in it")
    if not path.is_file():
        raise GraspFileError(f"no file {path}; give the path of a {kind} file")
    with reading(path, GraspFileError, f"a {kind} file: {EXPECTED[kind]}; download it again if it is damaged", *UNTYPED):
        try:
            return list(readers[kind](path))
        except _MoreThanData as error:
            raise GraspFileError(f"{path} holds more than tensors ({error}) and is not opened, for safety: it could run code; "
                                 "take the file that the project publishes, or save its grasps again with tensors or arrays, "
                                 "numbers and names only") from error
        except _NoEntry as error:
            raise GraspFileError(f"{path} is no {kind} file: it has no entry '{error}'; expected {EXPECTED[kind]}") from error


class _MoreThanData(Exception):
    """A pickle would build something other than data; the text names it."""


class _NoEntry(Exception):
    """An entry is missing; the text is its name."""


def _entry(entries: dict[str, Any], name: str) -> Any:
    if not isinstance(entries, dict):
        raise TypeError(f"it holds a {type(entries).__name__} where named entries should be")
    if name not in entries:
        raise _NoEntry(name)
    return entries[name]


def _load_tensors(path: Path) -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return torch.load(path, weights_only=True, map_location="cpu")
    except pickle.UnpicklingError as error:
        named = re.search(r"GLOBAL ([\w.]+)", str(error))
        raise _MoreThanData(f"it names {named[1]}" if named else "it is a pickle that cannot be checked") from error
    except KeyError as error:
        raise ValueError("it is no file that torch.save wrote") from error


def _pose(rotation: Rotation, position: ArrayLike) -> Float[np.ndarray, "4 4"]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), position
    return T


def _cmap(path: Path) -> Iterator[ForeignGrasp]:
    for q, obj, hand in _entry(_load_tensors(path), "metadata"):
        values = np.asarray(q, np.float64)
        T = _pose(Rotation.from_euler("XYZ", values[3:6]), values[:3])
        yield ForeignGrasp(str(hand), str(obj), 1.0, T, values[6:])


def _dexgraspnet(path: Path) -> Iterator[ForeignGrasp]:
    for entry in read_npy(path):
        qpos = {str(name): float(value) for name, value in _entry(entry, "qpos").items()}
        position = [_entry(qpos, name) for name in WRIST[:3]]
        angles = [_entry(qpos, name) for name in WRIST[3:]]
        joints = {name: value for name, value in qpos.items() if name not in WRIST}
        T = _pose(Rotation.from_euler("xyz", angles), position)
        yield ForeignGrasp("", path.stem, float(_entry(entry, "scale")), T, joints)


def _dexgraspbench(path: Path) -> Iterator[ForeignGrasp]:
    def pose(row: Float[np.ndarray, " k"]) -> Float[np.ndarray, "4 4"]:
        return _pose(Rotation.from_quat(row[3:7], scalar_first=True), row[:3])

    entry = read_npy(path).item()
    rows = np.atleast_2d(np.asarray(_entry(entry, "grasp_qpos"), np.float64))
    obj = np.atleast_2d(np.asarray(entry.get("obj_pose", [0, 0, 0, 1, 0, 0, 0]), np.float64))
    names = entry.get("joint_names")
    postures: list[list[Joints] | list[None]] = []
    for posture in ("grasp", "pregrasp", "squeeze"):
        stated = entry.get(f"{posture}_qpos")
        values = [] if stated is None else np.broadcast_to(np.asarray(stated, np.float64), rows.shape)[:, 7:]
        joints = [row if names is None else dict(zip(map(str, names), row.tolist(), strict=True)) for row in values]
        postures.append(joints or [None] * len(rows))
    for row, place, *joints in zip(rows, np.broadcast_to(obj, (len(rows), 7)), *postures, strict=True):
        T = np.linalg.inv(pose(place)) @ pose(row)
        scale = float(np.ravel(entry.get("obj_scale", 1.0))[0])
        yield ForeignGrasp(str(entry.get("hand", "")), Path(str(entry.get("obj_path", ""))).name, scale, T, *joints)


class _Harmless(pickle.Unpickler):
    """Builds arrays, numbers, strings and containers, and refuses everything else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in HARMLESS:
            raise _MoreThanData(f"it names {module}.{name}")
        return super().find_class(module, name)


def read_npy(path: Path) -> Shaped[np.ndarray, "..."]:
    """An array of objects from a npy file."""
    file = io.BytesIO(path.read_bytes())  # a file makes room for the length of a header that it does not have
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    if not dtype.hasobject:
        raise ValueError(f"it is an array of {dtype}, not of grasps")
    data = file.read()
    # Objects are numbered, and the reader makes room for the highest number that is stated.
    if any(operation.name in {"PUT", "LONG_BINPUT"} and int(number or 0) > len(data)
           for operation, number, _ in pickletools.genops(data)):
        raise ValueError("it numbers more objects than it can hold")
    loaded = _Harmless(io.BytesIO(data)).load()
    return np.asarray(loaded, dtype=object).reshape(shape)


def in_order(joints: Joints, moving: Sequence[str], independent: Sequence[str]) -> list[float]:
    """Values of the independent joints, of the names of these and of all that move, followers included."""
    give = "give the description that the data was made with (hands=...)"
    if isinstance(joints, dict):
        # Names of MuJoCo's Shadow hand begin with the robot's.
        values = {**joints, **{name.rpartition(":")[2]: value for name, value in joints.items()}}
        if missing := [name for name in independent if name not in values]:
            raise GraspFileError(
                f"the grasp has no joint {', '.join(missing[:4])} among {', '.join(list(joints)[:6])}; {give}")
        return [values[name] for name in independent]
    names = moving if len(joints) == len(moving) else independent
    if len(joints) != len(names):
        raise GraspFileError(f"the grasp has {len(joints)} joints, the hand {len(moving)} that move, {len(independent)} "
                             f"of them independent; {give}")
    by_name = dict(zip(names, joints.tolist(), strict=True))
    return [by_name[name] for name in independent]


def import_grasps(
    paths: Sequence[Path], kind: Format, hands: Mapping[str, str], obj: str | None = None
) -> tuple[dict[str, GraspBatch], dict[str, str]]:
    """Read a project's files: grasps by hand, and why objects are missing, by their names.

    Args:
        hands: Our names or paths of hands, by the names in the files; the entry '' stands for all others.
        obj: Object of all grasps, for files that name it otherwise or not at all.
    """
    if not paths:
        raise OptionError(f"no file to import was given; name at least one {kind} file")
    groups: dict[tuple[str, str, float], list[ForeignGrasp]] = {}
    named: set[str] = set()
    spelled: dict[Any, str] = {}
    for path in paths:
        for grasp in read_foreign(path, kind):
            named.add(grasp.hand)
            hand = hands.get(grasp.hand, hands.get("") or grasp.hand)
            if not hand:
                raise OptionError(f"{path} does not name its hand; name it with hands=...")
            if not (obj or grasp.object):
                raise OptionError(f"{path} does not name its object; name it with object=...")
            file = locate_hand(hand)
            hand = spelled.setdefault((file.path.resolve(), file.link), hand)  # however its path was given
            groups.setdefault((hand, obj or grasp.object, grasp.scale), []).append(grasp)
    if named and (unknown := sorted(hands.keys() - named - {""})):
        theirs = ", ".join(sorted(named - {""})) or "none"
        raise OptionError(f"no grasp is of a hand called {', '.join(unknown)}; the hands in the files are {theirs} (hands=...)")
    require_distinct_names(list(spelled.values()), ())
    batches: dict[str, list[GraspBatch]] = {}
    missing: dict[str, str] = {}
    for (hand, name, scale), grasps in groups.items():
        try:
            batches.setdefault(hand, []).append(_batch(hand, name, scale, grasps, kind))
        except ObjectError as error:
            missing[name] = str(error)
    return {hand: GraspBatch.concatenate(parts) for hand, parts in batches.items() if parts}, missing


def _batch(hand_name: str, obj_name: str, scale: float, grasps: list[ForeignGrasp], origin: str) -> GraspBatch:
    hand, obj = load_hand(hand_name), load_object(obj_name, scale=scale)
    T = torch.from_numpy(np.stack([grasp.T_object_wrist for grasp in grasps])).float()
    names = hand.tree.moving_names, hand.tree.joint_names
    unknown = [math.nan] * len(names[1])
    q, pregrasp, squeeze = (torch.tensor([unknown if joints is None else in_order(joints, *names) for joints in column])
                            for column in zip(*((g.joints, g.pregrasp, g.squeeze) for g in grasps), strict=True))
    made = GraspBatch.create(
        hand, obj, T, q, pregrasp_joints=pregrasp, squeeze_joints=squeeze, provenance=f"imported from {origin}")
    return with_sources(made, hand_name, obj_name, scale)
