"""GraspBatch: grasps of one hand, predicted or synthesised, tried or not, and their files."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.errors import GraspFileError
from dro_grasp.files import check_output, replacing
from dro_grasp.grasps.codec import FLOATS, LISTS, TEXTS, UNTRIED, decode, encode
from dro_grasp.grasps.table import read_table, table_bytes

__all__ = ["GraspBatch"]


@runtime_checkable
class HandIdentity(Protocol):
    """What a batch records of a hand; every Hand has it."""

    @property
    def name(self) -> str: ...

    @property
    def sha256(self) -> str: ...

    @property
    def tree(self) -> Any: ...


@dataclass(frozen=True)
class GraspBatch:
    """n grasps of one hand, of one or several objects.

    Missing values are NaN within a column and None for a whole column. A grasp was tried when its protocol is
    not the empty string; `success` means nothing for the others.
    """

    T_object_wrist: Float[Tensor, "n 4 4"]
    """Pose of the hand description's root link in the object's mesh frame [m]."""
    joints: Float[Tensor, "n n_dof"]
    """Independent joints of the grasp [rad or m]."""
    hand: str
    """Name of the hand."""
    hand_sha256: str
    """Hash of the hand's description."""
    wrist_link: str
    """Name of the root link."""
    joint_names: tuple[str, ...]
    """Names of the independent joints, the order of `joints`."""
    object: tuple[str, ...]
    """Name of each grasp's object."""
    object_sha256: tuple[str, ...]
    """Hash of each grasp's object."""
    seed: Int[Tensor, " n"]
    """Seed each grasp was made with."""
    split: tuple[str, ...]
    """"train", "validate", "test", or empty, one per grasp."""
    provenance: tuple[str, ...]
    """How each grasp was made, with model and version."""
    pregrasp_joints: Float[Tensor, "n n_dof"] | None = None
    """Opened joints from which the grasp is closed; the controller makes them where missing."""
    squeeze_joints: Float[Tensor, "n n_dof"] | None = None
    """Joint targets that press on the object; the controller makes them where missing."""
    score: Float[Tensor, " n"] | None = None
    """Higher is better."""
    success: Bool[Tensor, " n"] | None = None
    """Outcome of the trial."""
    displacement: Float[Tensor, " n"] | None = None
    """Largest displacement of the object in the trial [m]."""
    rotation: Float[Tensor, " n"] | None = None
    """Largest rotation of the object in the trial [rad]."""
    penetration: Float[Tensor, " n"] | None = None
    """Deepest penetration in the grasp pose [m]."""
    protocol: tuple[str, ...] | None = None
    """Protocol of each grasp's trial; the empty string where there was none."""
    extra: dict[str, Any] = field(default_factory=dict)
    """Further columns by name: tensors (n) or (n k), or lists of n values."""

    def __post_init__(self) -> None:
        """Give tried grasps a protocol and refuse columns of unequal length."""
        if self.success is not None and self.protocol is None:
            object.__setattr__(self, "protocol", ("unknown",) * len(self))
        names = (*TEXTS, *FLOATS, *LISTS, "T_object_wrist", "seed", "success", "protocol")
        columns = {name: getattr(self, name) for name in names} | self.extra
        wrong = {name: len(c) for name, c in columns.items() if c is not None and len(c) != len(self)}
        if wrong:
            raise ValueError(f"a batch of {len(self)} grasps has columns of other lengths: {wrong}")
        if self.joints.shape[1] != len(self.joint_names):
            raise ValueError(f"{self.joints.shape[1]} values for {len(self.joint_names)} joint names")

    @staticmethod
    def create(
        hand: Any,
        obj: Any,
        T_object_wrist: Float[Tensor, "n 4 4"],
        joints: Float[Tensor, "n n_dof"],
        **optional: Any,
    ) -> GraspBatch:
        """A batch for a Hand and an ObjectModel, or a sequence of n ObjectModels.

        Args:
            hand: The hand: name, sha256 and tree are recorded.
            obj: The object or one object per grasp: name, sha256 and split are recorded.
            T_object_wrist: Wrist poses in the object's frame [m].
            joints: Independent joints [rad or m].
            optional: Any other field of GraspBatch; `seed` may be one int, `provenance` one string.
        """
        n = len(joints)
        objects = list(obj) if isinstance(obj, Sequence) else [obj] * n
        seed = optional.pop("seed", 0)
        provenance = optional.pop("provenance", "")
        fields = {
            "hand": hand.name, "hand_sha256": hand.sha256, "wrist_link": hand.tree.link_names[0],
            "joint_names": tuple(hand.tree.joint_names), "object": tuple(o.name for o in objects),
            "object_sha256": tuple(o.sha256 for o in objects), "split": tuple(o.split or "" for o in objects),
            "seed": seed if isinstance(seed, Tensor) else torch.full((n,), int(seed), dtype=torch.int64),
            "provenance": (provenance,) * n if isinstance(provenance, str) else tuple(provenance),
        }
        return GraspBatch(T_object_wrist=T_object_wrist, joints=joints, **(fields | optional))

    def __len__(self) -> int:
        return len(self.joints)

    def __getitem__(self, index: int | slice | Sequence[int] | Tensor) -> GraspBatch:
        """The grasps at an index, slice, list of indices, index tensor or mask; always a batch."""
        rows = torch.arange(len(self))
        if isinstance(index, int):
            if not -len(self) <= index < len(self):
                raise IndexError(f"grasp {index} of a batch of {len(self)}")
            chosen = rows[index].reshape(1)
        else:
            chosen = rows[index if isinstance(index, slice) else torch.as_tensor(index if len(index) else rows[:0]).cpu()]
        return self._take(chosen)

    def _take(self, rows: Int[Tensor, " k"]) -> GraspBatch:
        places = rows.tolist()

        def take(value: Any) -> Any:
            if value is None:
                return None
            return value[rows] if isinstance(value, Tensor) else type(value)(value[i] for i in places)

        changes = {name: take(getattr(self, name)) for name in self._columns()}
        return self.replace(**changes, extra={name: take(value) for name, value in self.extra.items()})

    @staticmethod
    def _columns() -> tuple[str, ...]:
        return ("T_object_wrist", "joints", "seed", "success", "protocol", *FLOATS, *LISTS, *TEXTS)

    def replace(self, **changes: Any) -> GraspBatch:
        """The same batch with other values for some fields."""
        return dataclasses.replace(self, **changes)

    @cached_property
    def tried(self) -> Bool[Tensor, " n"]:
        """Which grasps a trial has tried."""
        if self.protocol is None:
            return torch.zeros(len(self), dtype=torch.bool)
        return torch.tensor([p != UNTRIED for p in self.protocol], dtype=torch.bool)

    @staticmethod
    def concatenate(batches: Sequence[GraspBatch]) -> GraspBatch:
        """One batch after the other; a column that some lack is missing (NaN) for their grasps.

        Raises:
            ValueError: No batch at all, or batches of different hands.
        """
        if not batches:
            raise ValueError("nothing to concatenate: give at least one batch")
        first = batches[0]
        for other in batches[1:]:
            if (other.hand_sha256, other.joint_names) != (first.hand_sha256, first.joint_names):
                raise ValueError(f"grasps of hand '{other.hand}' cannot join those of '{first.hand}'")
        columns = GraspBatch._columns()
        changes = {name: _join([getattr(b, name) for b in batches], batches) for name in columns}
        names = dict.fromkeys(name for b in batches for name in b.extra)
        extra = {name: _join([b.extra.get(name) for b in batches], batches) for name in names}
        return first.replace(**changes, extra=extra)

    def sorted_by_score(self) -> GraspBatch:
        """Best score first; equal scores keep their order, grasps without score come last."""
        if self.score is None:
            return self
        return self._take((-self.score.nan_to_num(nan=-torch.inf)).argsort(stable=True))

    def bare(self) -> GraspBatch:
        """Poses, joints and objects alone, without outcomes and further columns."""
        empty: dict[str, Any] = dict.fromkeys((*FLOATS, *LISTS, "success", "protocol"))
        return self.replace(**empty, extra={})

    def with_trial(self, trial: Any) -> GraspBatch:
        """The batch with a trial's outcome.

        Args:
            trial: A TrialResult; its displacement and rotation are (n) or (n directions).
        """
        def largest(values: Any) -> Tensor:
            tensor = torch.as_tensor(values, dtype=torch.float32)
            return tensor.amax(-1) if tensor.ndim == 2 else tensor

        return self.replace(
            success=torch.as_tensor(trial.success), displacement=largest(trial.displacement),
            rotation=largest(trial.rotation), penetration=largest(trial.penetration),
            protocol=(trial.protocol,) * len(self),
        )

    def save(self, path: Path | str, notes: dict[str, Any] | None = None) -> None:
        """Write a grasp file (Parquet, format version 1); it appears whole or not at all.

        Args:
            path: The file; an existing one is replaced.
            notes: Plain values about the making, kept in the file's header for `read_notes`.

        Raises:
            OutputError: The path cannot be written.
        """
        path = check_output(path)
        with replacing(path) as temporary:
            temporary.write_bytes(self.to_bytes(notes))

    def to_bytes(self, notes: dict[str, Any] | None = None) -> bytes:
        """The grasp file that `save` writes."""
        columns, header = encode(self)
        return table_bytes(columns, header if notes is None else header | {"notes": notes})

    @staticmethod
    def load(path: Path | str | BytesIO) -> GraspBatch:
        """Read a grasp file, from a path or from memory.

        Raises:
            GraspFileError: No such file, or a truncated or foreign one, or one of another version.
        """
        table, header = read_table(path)
        return GraspBatch(**decode(table, header, str(path)))

    def require_hand(self, hand: HandIdentity) -> None:
        """Refuse a hand whose joints are not those of these grasps.

        Raises:
            GraspFileError: The joint names or the wrist link differ.
        """
        if tuple(hand.tree.joint_names) != self.joint_names or hand.tree.link_names[0] != self.wrist_link:
            raise GraspFileError(
                f"these grasps are for hand '{self.hand}' with joints {list(self.joint_names)}; "
                f"hand '{hand.name}' has {list(hand.tree.joint_names)}"
            )

    def to_pandas(self) -> Any:
        """The batch as a pandas DataFrame with the grasp file's columns (needs pandas)."""
        import tempfile

        import pyarrow.parquet as pq

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "grasps.parquet"
            self.save(path)
            return pq.read_table(path).to_pandas()


def _join(values: list[Any], batches: Sequence[GraspBatch]) -> Any:
    """Concatenate one column, filling in for the batches that lack it."""
    present = [v for v in values if v is not None]
    if not present:
        return None
    if isinstance(present[0], Tensor):
        fill = torch.nan if present[0].is_floating_point() else 0
        shape = present[0].shape[1:]
        return torch.cat([
            present[0].new_full((len(b), *shape), fill) if v is None else v
            for v, b in zip(values, batches, strict=True)
        ])
    filled = [[UNTRIED] * len(b) if v is None else list(v) for v, b in zip(values, batches, strict=True)]
    return type(present[0])(x for part in filled for x in part)
