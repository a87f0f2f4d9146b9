"""Files that came through the browser: kept small, unpacked with care, and found again."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path, PurePosixPath

from dro_grasp.errors import OptionError

MOST_BYTES = 20_000_000
"""Largest upload [bytes]."""
MOST_UNPACKED, MOST_FILES = 100_000_000, 1_000
"""Largest content of a ZIP file [bytes], and most files in it."""
DESCRIPTIONS = (".urdf", ".xml", ".mjcf")
"""Endings of hand descriptions."""


def store_upload(name: str, content: bytes, folder: Path) -> Path:
    """Write an upload into a folder; of a ZIP file, the hand description in it is returned.

    Args:
        name: What the browser calls it; only its last part counts.
        content: Its bytes.
        folder: An empty folder.

    Raises:
        OptionError: It is too large, its name is none, or a ZIP file holds no description, or paths that lead out of it.
    """
    plain = PurePosixPath(name.replace("\\", "/")).name
    if not plain or plain in {".", ".."}:
        raise OptionError(f"'{name}' is no file name")
    if len(content) > MOST_BYTES:
        raise OptionError(f"{plain} has {len(content) / 1e6:.0f} MB, at most {MOST_BYTES / 1e6:.0f} are taken; use the command "
                          "line for larger files")
    if not plain.lower().endswith(".zip"):
        path = folder / plain
        path.write_bytes(content)
        return path
    _unpack(plain, content, folder)
    found = sorted((p for p in folder.rglob("*") if p.suffix.lower() in DESCRIPTIONS), key=lambda p: (len(p.parts), p))
    urdf = [p for p in found if p.suffix.lower() == ".urdf"]
    if not found:
        raise OptionError(f"{plain} holds no URDF or MJCF file; pack the description together with its meshes")
    return (urdf or found)[0]


def _unpack(name: str, content: bytes, folder: Path) -> None:
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
        entries = archive.infolist()
    except zipfile.BadZipFile as error:
        raise OptionError(f"{name} is no ZIP file, or was cut short; pack it again") from error
    size = sum(entry.file_size for entry in entries)
    if size > MOST_UNPACKED or len(entries) > MOST_FILES:
        raise OptionError(f"{name} unpacks to {len(entries)} files of {size / 1e6:.0f} MB, at most {MOST_FILES} of "
                          f"{MOST_UNPACKED / 1e6:.0f} MB are taken")
    left = MOST_UNPACKED
    for entry in entries:
        target = folder / entry.filename
        if entry.filename.startswith("/") or ".." in PurePosixPath(entry.filename.replace("\\", "/")).parts:
            raise OptionError(f"{name} holds '{entry.filename}', which leads out of it; pack it again")
        if entry.is_dir():
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        with archive.open(entry) as source:  # sizes in a ZIP file's list may lie
            data = source.read(left + 1)
        left -= len(data)
        if left < 0:
            raise OptionError(f"{name} unpacks to more than it says")
        target.write_bytes(data)
