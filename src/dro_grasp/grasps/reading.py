"""Grasps of a file, or of all files of a folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from dro_grasp.errors import GraspFileError
from dro_grasp.files import given_path
from dro_grasp.grasps.batch import GraspBatch

PATTERN = "*.parquet"
"""Names of the files that are read in a folder."""


def load_grasps(path: Path | str) -> GraspBatch:
    """Read a grasp file, or all of one hand in a folder, such as `generate` writes for a folder of objects.

    Where objects of two files have the same name and are not the same, they are called as their files.

    Raises:
        GraspFileError: There is no file and no grasp, a file is foreign, or the files of the folder are of several hands.
    """
    path = given_path(path)
    batch = _folder(path) if path.is_dir() else GraspBatch.load(path)
    if len(batch) == 0:
        raise GraspFileError(f"{path} holds no grasp; generate again, perhaps without --only-successful")
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
    """The batches, where objects that share their name with another one have the name of their file."""
    versions: dict[str, set[str]] = {}
    for _, batch in batches:
        for name, sha256 in zip(batch.object, batch.object_sha256, strict=True):
            versions.setdefault(name, set()).add(sha256)
    for file, batch in batches:
        def label(name: str, stem: str = file.stem) -> str:
            return stem if len(versions.get(name, ())) > 1 else name

        asked_of = {(label(name), sha256): num for (name, sha256), num in batch.asked_of.items()}
        yield batch.replace(object=tuple(map(label, batch.object)), asked_of=asked_of)
