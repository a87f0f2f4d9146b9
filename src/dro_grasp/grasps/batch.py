"""GraspBatch: grasps of one hand, predicted or synthesized, evaluated or not."""

from __future__ import annotations

import dataclasses
import html
import importlib.util
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike
from torch import Tensor

from dro_grasp.errors import GraspFileError, ObjectError, OptionError
from dro_grasp.files import check_output, given_path, reading, replacing
from dro_grasp.grasps import columns, grasp_file
from dro_grasp.grasps.columns import NOT_EVALUATED, REASON
from dro_grasp.grasps.grasp_file import EXPECTED, encode, quaternions_wxyz, read_table, table_bytes

if TYPE_CHECKING:
    from dro_grasp.hands.hand import Hand
    from dro_grasp.objects.shape import ObjectModel


@dataclass(frozen=True, eq=False)
class GraspBatch:
    """n grasps of one hand, of one or several objects.

    Every column exists for every grasp. What is unknown of a grasp is NaN in columns of floats and the empty string in
    columns of text. `GraspBatch.create` and `load` fill in the columns that they are not given.
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
    """"train", "few_shot", "validate", "test", or empty, one per grasp."""
    provenance: tuple[str, ...]
    """How each grasp was made, with model and version."""
    pregrasp_joints: Float[Tensor, "n n_dof"]
    """Opened joints from which the hand closes [rad or m]; a row of NaN is not stated, and `complete` makes it."""
    squeeze_joints: Float[Tensor, "n n_dof"]
    """Joint targets that press on the object [rad or m]; a row of NaN is not stated."""
    score: Float[Tensor, " n"]
    """Predicted log-odds that the grasp holds; higher is better."""
    energy: Float[Tensor, " n"]
    """Grasp energy; lower is better."""
    payload: Float[Tensor, " n"]
    """Largest mass that the grasp is predicted to hold whichever way gravity pulls, where it squeezes for it [kg]."""
    squeeze_force: Float[Tensor, " n"]
    """Sum of the normal forces on the object at the squeeze [N]."""
    squeeze_torque: Float[Tensor, "n n_dof"]
    """Torques of the joints at the squeeze [Nm, N where they slide]; a row of NaN is unknown."""
    trial_success: Bool[Tensor, " n"]
    """What `success` returns; False for all while no grasp has been evaluated."""
    displacement: Float[Tensor, " n"]
    """Largest displacement of the object in the trial [m]."""
    rotation: Float[Tensor, " n"]
    """Largest rotation of the object in the trial [rad]."""
    penetration: Float[Tensor, " n"]
    """Deepest penetration in the grasp pose [m]."""
    robustness: Float[Tensor, " n"]
    """Share of a grasp's trials in which it held, under a protocol that perturbs."""
    fingers_in_contact: Float[Tensor, " n"]
    """Number of fingers that touch the object after closing in the trial."""
    protocol: tuple[str, ...]
    """Protocol of each grasp's trial; the empty string where there was none."""
    extra: dict[str, Any] = field(default_factory=dict)
    """Further columns by name: tensors (n) or (n k), or sequences of n values."""
    asked_of: columns.Asked = field(default_factory=dict)
    """How many grasps of an object were asked for, by its name and hash, where that is known; see `asked`."""

    def __post_init__(self) -> None:
        """Refuse columns of unequal length and successes without a trial: ValueError."""
        columns.require_fit(self, len(self.joint_names))

    @staticmethod
    def create(
        hand: Hand, obj: ObjectModel | Sequence[ObjectModel], T_object_wrist: ArrayLike, joints: ArrayLike,
        **optional: Any,
    ) -> GraspBatch:
        """A batch for a hand and one or several objects.

        Numbers may be arrays or lists in any precision; they become single.

        Args:
            hand: The hand: name, sha256 and tree are recorded.
            obj: The object or one object per grasp: name, sha256 and split are recorded.
            T_object_wrist: Wrist poses in the object's frame, (n, 4, 4) [m].
            joints: Independent joints, (n, n_dof) [rad or m].
            optional: Any other field of GraspBatch; `seed` may be one int, `provenance` one string.

        Raises:
            OptionError: A column has another shape, poses or joints are not finite, or a pose is no rigid motion.
        """
        T_object_wrist, joints = columns.placed(T_object_wrist, joints, len(hand.tree.joint_names))
        objects = list(obj) if isinstance(obj, Sequence) else [obj] * len(joints)
        fields = {
            "hand": hand.name, "hand_sha256": hand.sha256, "wrist_link": hand.tree.link_names[0],
            "joint_names": tuple(hand.tree.joint_names), "object": tuple(o.name for o in objects),
            "object_sha256": tuple(o.sha256 for o in objects), "split": tuple(o.split or "" for o in objects),
        }
        fields = columns.filled(joints, fields, optional)
        return GraspBatch(T_object_wrist=T_object_wrist, joints=joints, **fields)

    @staticmethod
    def none(hand: Hand, obj: ObjectModel) -> GraspBatch:
        """No grasp at all."""
        return GraspBatch.create(hand, obj, torch.zeros(0, 4, 4), torch.zeros(0, hand.tree.n_dof))

    def __len__(self) -> int:
        return len(self.joints)

    def __iter__(self) -> Iterator[GraspBatch]:
        return (self[i] for i in range(len(self)))

    def __getitem__(
        self, index: int | slice | Sequence[int] | Sequence[bool] | Int[Tensor, "*k"] | Bool[Tensor, " n"]
    ) -> GraspBatch:
        """The grasps at an index, slice, list of indices, index tensor or mask; always a batch.

        Raises:
            OptionError: It is none of these, such as a single True.
            IndexError: There is no such grasp.
        """
        return self._take(columns.rows_at(index, len(self)))

    def _take(self, rows: Int[Tensor, " k"]) -> GraspBatch:
        fields = {name: columns.taken(getattr(self, name), rows) for name in columns.COLUMNS}
        extra = {name: columns.taken(column, rows) for name, column in self.extra.items()}
        return self.replace(**fields, extra=extra, asked_of={})

    @property
    def success(self) -> Bool[Tensor, " n"]:
        """Whether each grasp held in its trial; False for those without one where others have had theirs (`evaluated`).

        Raises:
            OptionError: No grasp has been evaluated, so that nothing is known of any.
        """
        if len(self) and not self.evaluated.any():
            raise OptionError("these grasps have not been tried, so none is known to hold; run trials first: "
                              "grasps = dro_grasp.evaluate(dro_grasp.GraspProblem(hand, obj), grasps), or grasps.with_trial")
        return self.trial_success

    def by_object(self) -> Iterator[tuple[str, GraspBatch]]:
        """Each object's name with its grasps, as the objects appear; a second one of its name, by the hash, is `NAME (2)`."""
        parts = ((name, self[rows]) for name, rows in columns.places(self.object, self.object_sha256).items())
        return ((name, part.replace(asked_of=columns.asked_among(self.asked_of, part))) for name, part in parts)

    def replace(self, **changes: Any) -> GraspBatch:
        """The same batch with other values for some fields, `success` among them."""
        if "success" in changes:
            changes["trial_success"] = changes.pop("success")
        return dataclasses.replace(self, **changes)

    def without(self, *names: str) -> GraspBatch:
        """The same batch, in which some columns are unknown for every grasp; further columns are gone.

        Raises:
            ValueError: No such column, or one that is always known, or one of the trial's (see `without_trial`).
        """
        if wrong := [name for name in names if name not in {*columns.MAY_BE_UNKNOWN, *self.extra}]:
            raise ValueError(f"columns {wrong} cannot be left out; these can: {[*columns.MAY_BE_UNKNOWN, *self.extra]}")
        fields = {name: columns.unknown(name, self.joints) for name in names if name in columns.MAY_BE_UNKNOWN}
        return self.replace(**fields, extra={name: c for name, c in self.extra.items() if name not in names})

    @cached_property
    def evaluated(self) -> Bool[Tensor, " n"]:
        """Which grasps have been through a trial."""
        return torch.tensor([p != NOT_EVALUATED for p in self.protocol], dtype=torch.bool, device=self.joints.device)

    @property
    def asked(self) -> int | None:
        """How many grasps were asked for, of which these are the ones that were found; None if that is unknown.

        A method that returns fewer grasps than it was asked for has failed with the others, so success rates are of this
        number. Joined batches were asked for the sum. A selection answers no request.
        """
        return columns.asked_in_all(self)

    @property
    def out_of(self) -> int:
        """What a success rate of these grasps is of: what was asked for, or, where that is unknown, the grasps there are."""
        return len(self) if self.asked is None else self.asked

    def with_asked(self, num: int) -> GraspBatch:
        """The batch as the answer to a request for `num` grasps of its object.

        Raises:
            OptionError: There are more grasps than that, or they are of several objects; state it for each, then join them.
        """
        return self.replace(asked_of=columns.asked_once(self, num))

    @property
    def wrist_position(self) -> Float[Tensor, "n 3"]:
        """Position of the root link in the object's frame [m]."""
        return self.T_object_wrist[:, :3, 3]

    @property
    def wrist_quaternion_wxyz(self) -> Float[Tensor, "n 4"]:
        """Orientation of the root link in the object's frame, a unit quaternion."""
        return quaternions_wxyz(self.T_object_wrist)

    @property
    def confidence(self) -> Float[Tensor, " n"]:
        """Predicted probability of holding, of which the score is the log-odds; NaN without a score."""
        return self.score.double().sigmoid()

    @property
    def states_closing(self) -> Bool[Tensor, " n"]:
        """Which grasps state both pregrasp and squeeze."""
        return torch.stack([self.pregrasp_joints, self.squeeze_joints]).isfinite().all(-1).all(0)

    def in_parts(self, size: int) -> Iterator[GraspBatch]:
        """The grasps in parts of this size; the last may be smaller."""
        return (self[slice(start, start + size)] for start in range(0, len(self), size))

    @staticmethod
    def concatenate(batches: Sequence[GraspBatch]) -> GraspBatch:
        """One batch after the other; further columns that some lack are unknown for their grasps.

        Raises:
            ValueError: No batch at all, or batches of different hands.
        """
        if not batches:
            raise ValueError("nothing to concatenate: give at least one batch")
        first, lengths = batches[0], [len(b) for b in batches]
        for other in batches[1:]:
            if (other.hand_sha256, other.joint_names) != (first.hand_sha256, first.joint_names):
                raise ValueError(f"grasps of hand '{other.hand}' cannot join those of '{first.hand}'")
        fields = {name: columns.joined([getattr(b, name) for b in batches], lengths) for name in columns.COLUMNS}
        names = dict.fromkeys(name for b in batches for name in b.extra)
        extra = {name: columns.joined([b.extra.get(name) for b in batches], lengths) for name in names}
        return first.replace(**fields, extra=extra, asked_of=columns.asked_joined(batches))

    def sorted_by_score(self) -> GraspBatch:
        """Best score first; equal scores keep their order, grasps without score come last."""
        return self._sorted(-self.score)

    def sorted_by_energy(self) -> GraspBatch:
        """Lowest energy first; equal energies keep their order, grasps without energy come last."""
        return self._sorted(self.energy)

    def _sorted(self, cost: Float[Tensor, " n"]) -> GraspBatch:
        return self._take(cost.nan_to_num(nan=torch.inf).argsort(stable=True)).replace(asked_of=self.asked_of)

    def poses_only(self) -> GraspBatch:
        """Poses, joints, objects and their making alone, without outcomes and further columns."""
        return self.replace(extra={}).without(*columns.MAY_BE_UNKNOWN).without_trial()

    def with_poses(self, T_object_wrist: Float[Tensor, "n 4 4"], joints: Float[Tensor, "n n_dof"]) -> GraspBatch:
        """The batch at other poses and joints; everything that belongs to the poses before is unknown or gone."""
        stale = [name for name in self.extra if name in columns.OF_POSES or name.startswith(columns.ENERGY_TERM)]
        rest = self.without(*columns.MAY_BE_UNKNOWN, *stale).without_trial()
        return rest.replace(T_object_wrist=T_object_wrist, joints=joints)

    def with_trial(self, trial: Any) -> GraspBatch:
        """The batch with the outcome of a trial, a TrialResult; why grasps failed and what they touched are further columns."""
        return self.replace(**columns.outcomes(trial, len(self), self.extra))

    def without_trial(self) -> GraspBatch:
        """The batch as if no grasp had been evaluated."""
        fields = {name: columns.unknown(name, self.joints) for name in columns.MEASURED}
        return self.replace(**fields, extra={name: c for name, c in self.extra.items() if name not in columns.FURTHER})

    def save(self, path: Path | str, notes: dict[str, Any] | None = None) -> None:
        """Write a grasp file (Parquet, format version 1); it appears whole or not at all.

        Args:
            path: The file; an existing one is replaced.
            notes: Plain values about the making, kept in the file's header.

        Raises:
            OutputError: The path cannot be written, or its name does not end in `.parquet`.
        """
        path = check_output(path, ".parquet")
        with replacing(path) as temporary:
            temporary.write_bytes(self.to_bytes(notes))

    def to_bytes(self, notes: dict[str, Any] | None = None) -> bytes:
        """The grasp file that `save` writes."""
        table, header = encode(self)
        return table_bytes(table, header if notes is None else header | {"notes": notes})

    @staticmethod
    def load(path: Path | str | BytesIO) -> GraspBatch:
        """Read a grasp file, from a path or from memory.

        Raises:
            GraspFileError: No such file, or a truncated or foreign one, or one of another version.
        """
        with reading(path, GraspFileError, EXPECTED):
            return GraspBatch(**grasp_file.decode(*read_table(path), str(path)))

    def to_pandas(self) -> Any:
        """The batch as a pandas DataFrame with the grasp file's columns.

        Raises:
            OptionError: pandas is not installed.
        """
        if importlib.util.find_spec("pandas") is None:
            raise OptionError("to_pandas needs pandas, which is not installed; install it with: pip install pandas")
        return pa.table(encode(self)[0]).to_pandas()

    def require_hand(self, hand: Hand) -> None:
        """Refuse a hand whose joints are not those of these grasps: GraspFileError."""
        if tuple(hand.tree.joint_names) != self.joint_names or hand.tree.link_names[0] != self.wrist_link:
            raise GraspFileError(
                f"these grasps are for hand '{self.hand}' with joints {list(self.joint_names)}; "
                f"hand '{hand.name}' has {list(hand.tree.joint_names)}. Load the hand that the grasps name"
            )

    def require_object(self, obj: ObjectModel) -> None:
        """Refuse an object that has neither the name nor the content of that of these grasps: ObjectError."""
        named = set(zip(self.object, self.object_sha256, strict=True))
        other = [name for name, sha256 in named if name and sha256 and name != obj.name and sha256 != obj.sha256]
        if other:
            raise ObjectError(f"these grasps are for object '{min(other)}', and '{obj.name}' is another one; load the object "
                              "that the grasps name, or say that you mean another (another=True)")

    def __repr__(self) -> str:
        return f"GraspBatch({sentence(self)})"

    def _repr_html_(self) -> str:
        return html_table(self)


PATTERN = "*.parquet"  # Names of the files that are read in a folder


def load_grasps(path: Path | str) -> GraspBatch:
    """Read a grasp file, or all of one hand in a folder, such as `generate` writes for a folder of objects.

    Where objects of two files have the same name and are not the same, they are called as their files.

    Raises:
        GraspFileError: There is no file and no grasp, a file is foreign, or the files of the folder are of several hands.
    """
    path = given_path(path)
    batch = _folder(path) if path.is_dir() else GraspBatch.load(path)
    if len(batch) == 0:
        raise GraspFileError(f"{path} holds no grasp; generate again, perhaps without only_successful=True")
    return batch


def _folder(folder: Path) -> GraspBatch:
    files = sorted(folder.glob(PATTERN))
    batches = [(file, batch) for file in files if len(batch := GraspBatch.load(file)) or batch.asked]
    if not any(len(batch) for _, batch in batches):
        held = "only grasp files without any grasp" if files else "no grasp file (.parquet)"
        raise GraspFileError(f"folder {folder} holds {held}; give a grasp file, or a folder that `generate --output` filled")
    first, one = batches[0]
    for file, batch in batches[1:]:
        if (batch.hand_sha256, batch.joint_names) != (one.hand_sha256, one.joint_names):
            raise GraspFileError(f"{first} has grasps of hand '{one.hand}', {file} of '{batch.hand}'; give the files one by "
                                 "one, or a folder for each hand")
    return GraspBatch.concatenate(list(_told_apart(batches)))


def _told_apart(batches: list[tuple[Path, GraspBatch]]) -> Iterator[GraspBatch]:
    """Batches in which objects of one name that are not the same are called as their files, and found by what they record."""
    versions: dict[str, set[str]] = {}
    for _, batch in batches:
        for name, sha256 in zip(batch.object, batch.object_sha256, strict=True):
            versions.setdefault(name, set()).add(sha256)
    for file, batch in batches:
        def label(name: str, stem: str = file.stem) -> str:
            return stem if len(versions.get(name, ())) > 1 else name

        asked_of = {(label(name), sha256): num for (name, sha256), num in batch.asked_of.items()}
        labels, extra = tuple(map(label, batch.object)), dict(batch.extra)
        if labels != batch.object:
            files = extra.get(columns.OBJECT_FILE, ("",) * len(batch))
            extra[columns.OBJECT_FILE] = tuple(
                file or (name if name != new else "") for file, name, new in zip(files, batch.object, labels, strict=True))
        yield batch.replace(object=labels, asked_of=asked_of, extra=extra)


DUPLICATE_DISTANCE = 0.005  # Two posed hands whose surface points lie closer together on average count as one grasp [m] (ours)
HAND_POINTS = 64  # Surface points that are compared (ours)


def distinct(hand: Hand, grasps: GraspBatch, earlier: GraspBatch | None = None) -> Bool[Tensor, " n"]:
    """Grasps that are not near-duplicates of an earlier grasp of the same object, be it in this batch or in `earlier`."""
    n_earlier = 0 if earlier is None else len(earlier)
    joined = grasps if earlier is None else GraspBatch.concatenate([earlier.poses_only(), grasps.poses_only()])
    thin = hand.with_points(min(HAND_POINTS, hand.n_points))
    points = thin.points(joined.joints, joined.T_object_wrist)
    keep = torch.ones(len(joined), dtype=torch.bool)
    names = sorted(set(joined.object))
    owner = torch.tensor([names.index(name) for name in joined.object])
    for i in range(max(1, n_earlier), len(joined)):
        before = (keep[:i] & (owner[:i] == owner[i])).nonzero()[:, 0]
        if len(before):
            apart = (points[before] - points[i]).norm(dim=-1).mean(-1)
            keep[i] = bool(apart.min() >= DUPLICATE_DISTANCE)
    return keep[n_earlier:]


ROWS = 10  # Most grasps in the HTML table (ours)
NAMES = 3  # Most objects that are named (ours)


def percent(confidence: float) -> str | None:
    """A probability for people; None for NaN, which is unknown."""
    return None if math.isnan(confidence) else f"{100 * confidence:.0f} %"


def sentence(grasps: Any) -> str:
    """Number of grasps, hand, objects, outcome and range of score or energy."""
    missing = grasps.out_of - len(grasps)
    short = f" of {grasps.out_of} asked for" if missing else ""
    parts = [f"{len(grasps)} grasp{'' if len(grasps) == 1 else 's'}{short}", f"hand '{grasps.hand}'", _objects(grasps)]
    protocols = Counter(p for p in grasps.protocol if p != NOT_EVALUATED)
    for protocol, count in protocols.items():
        held = sum(s for s, p in zip(grasps.trial_success.tolist(), grasps.protocol, strict=True) if p == protocol)
        count += missing if len(protocols) == 1 else 0
        parts.append(f"{held} of {count} hold under {protocol}")
    if not grasps.evaluated.all():
        parts.append("not evaluated" if not grasps.evaluated.any() else f"{int((~grasps.evaluated).sum())} not evaluated")
    for name, unit in (("score", ""), ("energy", ""), ("payload", " kg"), ("squeeze_force", " N")):
        known = getattr(grasps, name)
        known = known[known.isfinite()]
        if len(known):
            parts.append(f"{name.replace('_', ' ')} {float(known.min()):.2f} to {float(known.max()):.2f}{unit}")
    return ", ".join(part for part in parts if part)


def _objects(grasps: Any) -> str:
    names = list(dict.fromkeys(grasps.object))
    if not names:
        return ""
    named = ", ".join(f"'{name}'" for name in names[:NAMES])
    more = f" and {len(names) - NAMES} more" if len(names) > NAMES else ""
    return f"object{'s' if len(names) > 1 else ''} {named}{more}"


def html_table(grasps: Any) -> str:
    """The sentence above a table of the first grasps."""
    reasons = grasps.extra.get(REASON) or [None] * len(grasps)
    lines = []
    for i in range(min(len(grasps), ROWS)):
        outcome = ("success" if grasps.success[i] else "failure") if grasps.evaluated[i] else ""
        numbers = [float(column[i]) for column in (grasps.score, grasps.energy)]
        cells = [i, grasps.object[i], *("" if x != x else f"{x:.2f}" for x in numbers), outcome, reasons[i] or ""]
        lines.append("".join(f"<td>{html.escape(str(cell))}</td>" for cell in cells))
    heads = "".join(f"<th>{head}</th>" for head in ("grasp", "object", "score", "energy", "trial", "reason"))
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    more = f"<p>and {len(grasps) - ROWS} more</p>" if len(grasps) > ROWS else ""
    return f"<p>{html.escape(sentence(grasps))}</p><table><tr>{heads}</tr>{body}</table>{more}"
