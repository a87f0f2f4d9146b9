"""The hand and the objects of a grasp file: found by name, or in the user's own files that the grasps record."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import GraspFileError, HandError, ObjectError, OptionError
from dro_grasp.files import given_path
from dro_grasp.grasps.columns import (
    CAMERA,
    FRAME,
    HAND_FILE,
    OBJECT_CLOUD,
    OBJECT_FILE,
    OBJECT_MASS,
    OBJECT_SCALE,
    table_planes,
)
from dro_grasp.grasps.recorded_cloud import packed_cloud, unpacked_cloud

if TYPE_CHECKING:
    from dro_grasp.frames import NamedMotion
    from dro_grasp.grasps.batch import GraspBatch
    from dro_grasp.hands.hand import Hand
    from dro_grasp.objects.shape import ObjectModel


def with_sources(
    grasps: GraspBatch, hand: str, obj: str, scale: float, camera: NamedMotion | None = None, taken: ObjectModel | None = None
) -> GraspBatch:
    """Grasps of one object that record the files of their hand and object, unless their names are built-in, and the scale.

    `camera` is the pose of the camera that saw the object, in the frame of the grasps; `taken` a cloud that is in no file.
    """
    return recorded(grasps, hand_file(hand), object_file(obj) if taken is None else None, scale, camera, taken)


def hand_file(hand: str) -> str | None:
    """The file of a hand, and the part of it, if it was given by its path."""
    from dro_grasp.hands.description.loader import named, split_part
    from dro_grasp.hands.library import locate_hand

    file, link = split_part(hand)
    own = given_path(file).is_file() and locate_hand(hand).path == given_path(file)
    return named(given_path(file).resolve(), link) if own else None


def object_file(obj: str) -> str | None:
    """The file of an object, or its folder of DexGraspBench, if it was given by its path."""
    from dro_grasp.objects.catalogue import is_object_name, processed_folder

    path = given_path(obj)
    own = not is_object_name(obj) and (path.is_file() or processed_folder(path) is not None)
    return str(path.resolve()) if own else None


def recorded(
    grasps: GraspBatch, hand: str | None, obj: str | None, scale: float, camera: NamedMotion | None = None,
    taken: ObjectModel | None = None,
) -> GraspBatch:
    """Grasps of one object that record the files of their hand and object, or the cloud that was taken, and the camera.

    The scale is recorded with a file, and where it is not 1; that of a taken cloud is in its points.
    """
    import torch

    n, extra = len(grasps), {name: column for name, column in grasps.extra.items() if name != OBJECT_SCALE}
    if hand is not None:
        extra[HAND_FILE] = (hand,) * n
    if obj is not None:
        extra[OBJECT_FILE] = (obj,) * n
        extra.pop(OBJECT_CLOUD, None)  # the file has it
    if obj is not None or (scale != 1 and taken is None):
        extra[OBJECT_SCALE] = torch.full((n,), scale)
    if taken is not None:
        extra[OBJECT_CLOUD] = (packed_cloud(taken),) * n
    if camera is not None:
        extra[FRAME] = (camera.frame,) * n
        extra[CAMERA] = camera.T.reshape(1, 16).expand(n, 16)
    return grasps.replace(extra=extra)


def with_own_files(grasps: GraspBatch, hand: Hand, obj: ObjectModel) -> GraspBatch:
    """Grasps of one object that record its stated mass, and the files which a user's own hand and object were loaded from."""
    from dro_grasp.hands.library import BUILTIN_FOLDER

    read = hand.description
    own = read is not None and hand.name == read.name and read.path.parent != BUILTIN_FOLDER
    grasps = with_mass_of(grasps, obj)
    taken = obj if obj.is_cloud and obj.file is None else None
    return recorded(grasps, hand_file(read.source if read is not None and own else hand.name),
                    None if obj.file is None else object_file(obj.file), obj.scale, taken=taken)


def with_mass_of(grasps: GraspBatch, obj: ObjectModel) -> GraspBatch:
    """Grasps of one object that record the mass which was stated of it, and no other."""
    import torch

    extra = {name: column for name, column in grasps.extra.items() if name != OBJECT_MASS}
    if obj.stated_mass is not None:
        extra[OBJECT_MASS] = torch.full((len(grasps),), obj.stated_mass)
    return grasps.replace(extra=extra)


def require_pair(hand: Any, obj: Any) -> None:
    """Refuse anything but a hand and an object, in this order: OptionError."""
    from dro_grasp.hands.hand import Hand
    from dro_grasp.objects.shape import ObjectModel

    if isinstance(hand, ObjectModel) and isinstance(obj, Hand):
        raise OptionError("the hand and the object are swapped; give the hand first, then the object")
    for what, given, kind in (("hand", hand, Hand), ("object", obj, ObjectModel)):
        if not isinstance(given, kind):
            text = f"'{given}'" if isinstance(given, str | Path) else f"a {type(given).__name__}"
            example = text if isinstance(given, str | Path) else "NAME_OR_PATH"
            raise OptionError(f"the {what} is {text}; load it first: dro_grasp.load_{what}({example})")


def hand_of(grasps: GraspBatch, given: str | None) -> Hand:
    """The hand of a file's grasps, or the given one; HandError: it is not found; the message asks for `hand`."""
    from dro_grasp.hands.library import load_hand

    if given is not None:
        return load_hand(given)
    source = _recorded(grasps, HAND_FILE) or grasps.hand
    try:
        return load_hand(source)
    except HandError as error:
        raise HandError(f"the grasps are of hand '{grasps.hand}', which cannot be loaded ({error}); give its file with "
                        "hand=...") from error


def object_of(
    grasps: GraspBatch, given: str | None, scale: float | None = None, mass: float | None = None
) -> ObjectModel:
    """The object of grasps of one object, or the given one, with this mass [kg]; None takes the one that the grasps record.

    `scale` is that of the given one, or of an object whose grasps record none. None is 1, and what the grasps record for a
    given file.

    Raises:
        ObjectError: It is not found, and the message asks for --object; or the grasps record several masses.
    """
    from dro_grasp.objects.shape import with_mass

    mass = recorded_mass(grasps) if mass is None else mass
    obj = _object_of(grasps, given, scale)
    return obj if mass is None else with_mass(obj, mass)


def _object_of(grasps: GraspBatch, given: str | None, scale: float | None) -> ObjectModel:
    """The object, whatever was stated of its mass; a table in its cloud is kept if the grasps kept it."""
    from dro_grasp.objects.catalogue import load_object

    if given is not None:
        recorded_scale = 1.0 if object_file(given) is None else object_source(grasps)[1]
        return load_object(given, scale=recorded_scale if scale is None else scale)
    if (taken := _recorded(grasps, OBJECT_CLOUD)) is not None:
        return unpacked_cloud(taken, grasps.object[0])
    try:
        source, own_scale = object_source(grasps, 1.0 if scale is None else scale)
        pose = camera_pose(grasps)

        def loaded(keep_table: bool, height: float | None) -> ObjectModel:
            if pose is None:
                return load_object(source, scale=own_scale, keep_table=keep_table)
            from dro_grasp.objects.perception.scan import load_scan  # with the completion of clouds

            return load_scan(Path(source), pose.double().numpy(), own_scale, keep_table, height)

        planes, hashes = table_planes(grasps), set(grasps.object_sha256) - {""}
        height = None if pose is None or planes is None else float(planes[0, 3])
        obj = loaded(keep_table=False, height=height)
        if hashes and obj.sha256 not in hashes:
            others = [(keep, z) for keep in (False, True) for z in dict.fromkeys((height, None))][1:]
            for other in others if obj.table is not None else ():
                with suppress(ObjectError):
                    if (again := loaded(*other)).sha256 in hashes:
                        return again
        return obj
    except ObjectError as error:
        raise ObjectError(f"the grasps are of object '{grasps.object[0]}', which cannot be loaded ({error}); give its file "
                          "with object=..., and scale=... if it had one") from error


def require_one_object(grasps: GraspBatch, given: str | None, file: Path) -> None:
    """Refuse an object that is to stand for the one in a file, where the file has several: OptionError."""
    if given is not None and (number := len(list(grasps.by_object()))) > 1:
        raise OptionError(f"{file} holds grasps of {number} objects; another object fits a file with one")


def object_source(grasps: GraspBatch, scale: float = 1.0) -> tuple[str, float]:
    """File or name of the object of some grasps, and its scale; `scale` is for grasps that record none."""
    if OBJECT_SCALE in grasps.extra:
        known = grasps.extra[OBJECT_SCALE]
        known = known[known.isfinite()]
        scale = _as_given(known[0]) if len(known) else scale
    return _recorded(grasps, OBJECT_FILE) or grasps.object[0], scale


def recorded_mass(grasps: GraspBatch) -> float | None:
    """The mass that was stated of the object of some grasps [kg]; None for none. ObjectError: they record several."""
    if (column := grasps.extra.get(OBJECT_MASS)) is None:
        return None
    masses = column.unique(dim=0)
    known = [_as_given(mass) for mass in masses[masses.isfinite()]]
    if len(known) > 1 or (known and bool(column.isnan().any())):
        listed = " and ".join([f"{mass:g} kg" for mass in known] + ["none"] * bool(column.isnan().any()))
        raise ObjectError(f"the grasps of '{grasps.object[0]}' were made for several masses, {listed}; state one (mass=...), "
                          "or give files that are of one mass each")
    return known[0] if known else None


def _as_given(value: Float[Tensor, ""]) -> float:
    """A number of a file, which holds single precision: the shortest decimal is the one that was given."""
    return float(str(value.float().numpy()))


def pair_keys(grasps: GraspBatch) -> tuple[tuple[str, str], tuple[str, str | tuple[str, float]]]:
    """What tells the hands and the objects of grasps of one object apart: names, and hashes or, where unknown, the sources."""
    source = grasps.hand_sha256 or _recorded(grasps, HAND_FILE) or ""
    return (grasps.hand, source), (grasps.object[0], _known_hash(grasps) or object_source(grasps))


def frame_of(grasps: GraspBatch) -> str | None:
    """Name of the frame of grasps on a camera's cloud; None for grasps in the object's own frame."""
    return _recorded(grasps, FRAME)


def camera_pose(grasps: GraspBatch) -> Float[Tensor, "4 4"] | None:
    """Pose of the camera in the frame of grasps on its cloud [m]; None for grasps in the object's own frame."""
    frame = frame_of(grasps)
    return None if frame is None else grasps.extra[CAMERA][grasps.extra[FRAME].index(frame)].reshape(4, 4)


def made_for_another(name: str, given: str) -> str:
    """A sentence about grasps that are used with another hand or object than their own."""
    return (f"the grasps were made for another '{name}' than the given {given}: its file or scale has changed since, or only "
            "the name is the same")


def require_same(grasps: GraspBatch, hand: Hand, obj: ObjectModel) -> None:
    """Refuse a hand or an object that has changed since grasps of one object were made: GraspFileError."""
    for kind, name, stored, found in (
        ("hand", hand.name, grasps.hand_sha256, hand.sha256), ("object", obj.name, _known_hash(grasps), obj.sha256)
    ):
        if stored and stored != found:
            raise GraspFileError(f"the grasps were made for another version of {kind} '{name}' (hash {stored[:12]}, found "
                                 f"{found[:12]}); bring that version back, or synthesize again")


def _recorded(grasps: GraspBatch, column: str) -> str | None:
    return next((value for value in grasps.extra.get(column, ()) if value), None)


def _known_hash(grasps: GraspBatch) -> str:
    """Hash of the object of grasps of one object, empty if no grasp states it."""
    return next((sha256 for sha256 in grasps.object_sha256 if sha256), "")
