"""The training bundle: hands, object clouds and the grasps that training may use in one portable file.

The file is safetensors. Object points have 16 bits within the cloud's box, normals 8 bits. Reading it needs neither a
simulator nor a mesh library.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int, Shaped
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from dro_grasp.devices import on_device
from dro_grasp.errors import BundleError
from dro_grasp.files import UNTYPED, given_path, reading, replacing
from dro_grasp.geometry.se3 import compose, roma
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand

Tensors = dict[str, Shaped[Tensor, "..."]]  # The tensors of a file by key
FORMAT_VERSION = 1  # Version of the bundle file that this code writes and reads
HEADER = "dro_grasp_bundle"  # Key of the file's metadata that describes its content
MAX_BYTES = 60_000_000  # Largest bundle [bytes]. Ours: 500 objects, 130 hands and 100,000 grasps fit, and it is moved easily
HELD_OUT_HANDS = frozenset(f"assets/{name}" for name in ("inspire", "ability", "dclaw", "orca", "ezgripper"))
"""Hands that no shipped weights were trained on, for zero-shot and few-shot results. Ours."""
FEW_SHOT = "few_shot"
"""Split of a held-out hand's grasps on training objects: for fine-tuning studies, never for shipped weights."""
TRAINING = frozenset({"train", "hard_train", ""})
"""Splits of a training bundle; the empty one stands for an object of the user's own."""
SPLITS = {"train": TRAINING, "few_shot": frozenset({FEW_SHOT}), "validate": frozenset({"validate"})}
"""Splits that a bundle may hold, by the bundle's own split."""


def split_of(hand: str, object_split: str) -> str:
    """The split of a hand's grasps on an object: that of the object, unless the hand is held out."""
    return FEW_SHOT if hand in HELD_OUT_HANDS and object_split in TRAINING else object_split


@dataclass(frozen=True)
class ObjectCloud:
    """Surface points of an object [m], with outward unit normals."""

    points: Float[Tensor, "k 3"]
    normals: Float[Tensor, "k 3"]


@dataclass(frozen=True)
class HandGrasps:
    """All grasps of one hand."""

    T_object_wrist: Float[Tensor, "n 4 4"]
    joints: Float[Tensor, "n n_dof"]  # independent joints [rad or m]
    object_index: Int[Tensor, " n"]  # index into the bundle's objects

    def to(self, device: torch.device | str) -> HandGrasps:
        """The same grasps on another device."""
        return on_device(self, device)


@dataclass(frozen=True)
class Bundle:
    """The content of a bundle file."""

    hands: dict[str, Hand]
    objects: dict[str, ObjectCloud]
    grasps: dict[str, HandGrasps]  # by hand name. A hand may have none: pretraining needs its kinematics alone.

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names in the order of object_index."""
        return tuple(self.objects)

    @property
    def n_grasps(self) -> int:
        """Grasps of all hands."""
        return sum(len(g.joints) for g in self.grasps.values())

    @cached_property
    def fingerprint(self) -> str:
        """Twelve digits that tell bundles with other hands, objects or grasps apart."""
        named = [*(f"{name} {hand.sha256}" for name, hand in self.hands.items()), *self.objects]
        digest = sha256("".join(named).encode())
        clouds = [tensor for cloud in self.objects.values() for tensor in (cloud.points, cloud.normals)]
        grasps = [tensor for g in self.grasps.values() for tensor in (g.T_object_wrist, g.joints, g.object_index)]
        for tensor in (*clouds, *grasps):
            digest.update(tensor.cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()[:12]

    def summary(self) -> dict[str, Any]:
        """Counts of hands, objects and grasps."""
        return {"hands": {name: len(g.joints) for name, g in self.grasps.items()}, "objects": len(self.objects),
                "grasps": self.n_grasps}


def write_bundle(
    path: Path | str, hands: Sequence[Hand], objects: Mapping[str, ObjectCloud], grasps: Sequence[GraspBatch],
    splits: Set[str] = TRAINING, without_grasps: Sequence[Hand] = (),
) -> Bundle:
    """Write a training bundle of grasps of some splits, by these hands on objects with these clouds.

    Args:
        grasps: At least one grasp of each of these hands.
        splits: Splits that the grasps may be of.
        without_grasps: Further hands, for pretraining.
    """
    strangers = {b.hand for b in grasps if b.hand_sha256 not in {h.sha256 for h in hands}}
    if strangers:
        raise BundleError(f"grasps of {', '.join(sorted(strangers))} were given without these hands, or for other versions of "
                          "them; pass the hands they were made for")
    if not grasps:
        raise BundleError("no grasps were given; synthesize some on objects for training first")
    called = Counter(hand.name for hand in (*hands, *without_grasps))
    if double := sorted(name for name, count in called.items() if count > 1):
        raise BundleError(f"{', '.join(double[:5])} is the name of more than one hand; rename them, or leave out those that "
                          "have grasps already")
    names = list(objects)
    tensors: Tensors = {}
    header: dict[str, Any] = {"format_version": FORMAT_VERSION, "objects": names, "hands": []}
    for i, (name, cloud) in enumerate(objects.items()):
        tensors |= _pack_cloud(f"object.{i}", cloud, name)
    for i, hand in enumerate((*hands, *without_grasps)):
        header["hands"].append(_pack_hand(f"hand.{i}", hand, tensors))
        if i < len(hands):
            tensors |= _pack_grasps(f"grasps.{i}", hand, [b for b in grasps if b.hand_sha256 == hand.sha256], names, splits)
        else:
            tensors |= _grasp_tensors(f"grasps.{i}", torch.zeros(0, 4, 4), torch.zeros(0, hand.tree.n_dof), [])
    size = sum(t.numel() * t.element_size() for t in tensors.values())
    if size > MAX_BYTES:
        raise BundleError(f"the bundle would have {size / 1e6:.1f} MB, at most {MAX_BYTES / 1e6:.0f} MB are allowed; take "
                          "fewer objects or fewer grasps a pair (per_pair=...)")
    with replacing(path) as temporary:
        save_file(tensors, temporary, metadata={HEADER: json.dumps(header)})
    return load_bundle(path)


def load_bundle(path: Path | str) -> Bundle:
    """Read a training bundle.

    Raises:
        BundleError: The file is missing, truncated, foreign or of another version.
    """
    path = given_path(path)
    if not path.is_file():
        raise BundleError(f"no bundle at {path}; make one with `dro-grasp dataset bundle`")
    with reading(path, BundleError, "a bundle that is not cut short; make it again with `dro-grasp dataset bundle`",
                 *UNTYPED):
        with safe_open(path, "pt") as file:
            header = json.loads((file.metadata() or {}).get(HEADER, "null"))
            tensors = {key: file.get_tensor(key) for key in file.keys()}
        if not isinstance(header, dict):
            raise BundleError(f"{path} is a safetensors file but no bundle; make one with `dro-grasp dataset bundle`")
        if header.get("format_version") != FORMAT_VERSION:
            raise BundleError(f"{path} has bundle version {header.get('format_version')}, expected {FORMAT_VERSION}; make it "
                              "again with this version of dro-grasp")
        if unreal := [key for key, tensor in tensors.items() if not bool(tensor.isfinite().all())]:
            raise BundleError(f"{path}: '{unreal[0]}' holds NaN or infinity; make it again with `dro-grasp dataset bundle`")
        return _checked(_unpack(header, tensors))


def _checked(bundle: Bundle) -> Bundle:
    """Refuse, by a ValueError, hands, clouds and grasps that do not fit each other."""
    for name, cloud in bundle.objects.items():
        if cloud.points.shape != cloud.normals.shape or cloud.points.shape[1:] != (3,) or not len(cloud.points):
            raise ValueError(f"the cloud of object '{name}' has points {tuple(cloud.points.shape)}")
    for name, grasps in bundle.grasps.items():
        hand, n = bundle.hands[name], len(grasps.joints)
        if not (grasps.joints.shape == (n, hand.tree.n_dof) and grasps.T_object_wrist.shape == (n, 4, 4)
                and grasps.object_index.shape == (n,) and ((grasps.object_index >= 0) & (
                    grasps.object_index < len(bundle.objects))).all()):
            raise ValueError(f"the grasps of hand '{name}' do not fit it, or their objects")
        if hand.points(hand.canonical_joints()).shape != (hand.n_points, 3):
            raise ValueError(f"hand '{name}' has no points")
    return bundle


def _unpack(header: dict[str, Any], tensors: Tensors) -> Bundle:
    objects = {name: _unpack_cloud(f"object.{i}", tensors) for i, name in enumerate(header["objects"])}
    hands, grasps = {}, {}
    for i, plain in enumerate(header["hands"]):
        prefix = f"hand.{i}."
        hand = Hand.from_tensors(plain | {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)})
        hands[hand.name] = hand
        grasps[hand.name] = _unpack_grasps(f"grasps.{i}", tensors)
    return Bundle(hands, objects, grasps)


def _pack_cloud(key: str, cloud: ObjectCloud, name: str) -> Tensors:
    if not (cloud.points.isfinite().all() and cloud.normals.isfinite().all()):
        raise BundleError(f"the cloud of object '{name}' has non-finite values; check its mesh")
    low = cloud.points.amin(0)
    size = (cloud.points.amax(0) - low).clamp(min=1e-9)
    levels = ((cloud.points - low) / size * 65535).round().to(torch.int32)
    return {
        f"{key}.points": (levels - 32768).to(torch.int16), f"{key}.box": torch.stack([low, size]),
        f"{key}.normals": (cloud.normals * 127).round().to(torch.int8),
    }


def _unpack_cloud(key: str, tensors: Tensors) -> ObjectCloud:
    low, size = tensors[f"{key}.box"]
    points = (tensors[f"{key}.points"].float() + 32768) / 65535 * size + low
    return ObjectCloud(points, torch.nn.functional.normalize(tensors[f"{key}.normals"].float(), dim=-1))


def _pack_hand(key: str, hand: Hand, tensors: Tensors) -> dict[str, Any]:
    plain = {}  # values for the file's header; tensors go into the file
    for field, value in hand.to_tensors().items():
        if isinstance(value, Tensor):
            tensors[f"{key}.{field}"] = value.contiguous().clone()
        else:
            plain[field] = value
    return plain


def _pack_grasps(key: str, hand: Hand, batches: list[GraspBatch], names: list[str], splits: Set[str]) -> Tensors:
    if not batches:
        raise BundleError(f"no grasps of hand '{hand.name}'; synthesize some or leave the hand out")
    known = {name: i for i, name in enumerate(names)}
    for batch in batches:
        refused = {o for o, s in zip(batch.object, batch.split, strict=True) if s not in splits}
        if refused:
            raise BundleError(f"grasps on {', '.join(sorted(refused)[:5])} are held out for other uses than this bundle's "
                              f"({', '.join(sorted(s for s in splits if s)) or 'none'}); leave them out")
        missing = set(batch.object) - set(known)
        if missing:
            raise BundleError(f"no cloud was given for objects {', '.join(sorted(missing)[:5])}")
    T, joints = torch.cat([b.T_object_wrist for b in batches]), torch.cat([b.joints for b in batches])
    return _grasp_tensors(key, T, joints, [known[o] for b in batches for o in b.object])


def _grasp_tensors(key: str, T: Float[Tensor, "n 4 4"], joints: Float[Tensor, "n n_dof"], objects: list[int]) -> Tensors:
    quaternion = roma.rotmat_to_unitquat(T[:, :3, :3]) if len(T) else T.new_zeros(0, 4)
    return {
        f"{key}.position": T[:, :3, 3].contiguous(), f"{key}.quaternion_wxyz": roma.quat_xyzw_to_wxyz(quaternion).contiguous(),
        f"{key}.joints": joints.contiguous(), f"{key}.object": torch.tensor(objects, dtype=torch.int32),
    }


def _unpack_grasps(key: str, tensors: Tensors) -> HandGrasps:
    quaternion = tensors[f"{key}.quaternion_wxyz"]
    if quaternion.shape[-1:] != (4,) or not quaternion.is_floating_point():
        raise ValueError(f"'{key}.quaternion_wxyz' is {quaternion.dtype} of shape {tuple(quaternion.shape)}")
    T = torch.zeros(0, 4, 4)
    if len(quaternion):
        quaternion = torch.nn.functional.normalize(roma.quat_wxyz_to_xyzw(quaternion), dim=-1)
        T = compose(roma.unitquat_to_rotmat(quaternion), tensors[f"{key}.position"])
    return HandGrasps(T, tensors[f"{key}.joints"], tensors[f"{key}.object"].long())
