"""What can be asked for by name: built-in hands and objects, the user's own, and what a browser or a client sends."""

from __future__ import annotations

import io
import re
import tempfile
import zipfile
from collections.abc import Callable, Hashable
from functools import cached_property
from itertools import count
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from cachetools import LRUCache

from dro_grasp.errors import OptionError
from dro_grasp.files import free_name, reading
from dro_grasp.hands.description.urdf import find_mesh
from dro_grasp.hands.description.xml_files import parse_xml
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import hand_names, load_hand
from dro_grasp.objects.catalogue import load_object, object_names
from dro_grasp.objects.scenery import Scene, load_scene
from dro_grasp.objects.shape import ObjectModel

Kind = Literal["hand", "object", "scene"]  # What something is used as
MAX_LOADED: dict[Kind, int] = {"hand": 16, "object": 32, "scene": 8}
"""Most of each kind that stay loaded, those used last (ours); what was added loaded stays besides."""


class Library:
    """Hands, objects and scenes by name; each is loaded when it is first asked for, and those used last stay loaded."""

    def __init__(self) -> None:
        self.own: dict[Kind, dict[str, Any]] = {kind: {} for kind in MAX_LOADED}
        """What was added: by its name, what it is loaded from, or itself."""
        self._loaded = {kind: LRUCache[Hashable, Any](most) for kind, most in MAX_LOADED.items()}
        self._numbers = count(1)

    @cached_property
    def folder(self) -> tempfile.TemporaryDirectory[str]:
        """Where uploads are stored."""
        return tempfile.TemporaryDirectory(prefix="dro-grasp-")

    def close(self) -> None:
        """Delete the uploads."""
        self.folder.cleanup()

    def names(self, kind: Kind) -> tuple[str, ...]:
        """Names of a kind, those that were added first."""
        builtin = {"hand": hand_names, "object": object_names, "scene": list}[kind]()
        return tuple(dict.fromkeys([*self.own[kind], *builtin]))

    def add(self, kind: Kind, name: str, source: Any) -> None:
        """Name something, in the place of another of this name, by itself, what loads it, or its file or other name."""
        self.own[kind][name] = source
        self._loaded[kind].pop(name, None)

    def take(self, name: str, content: bytes, kind: Kind) -> str:
        """Store an upload that is to be used as a kind, and return the name under which it can be asked for.

        An upload replaces the one before of its name and kind; names that another kind has taken get a number.
        """
        folder = Path(self.folder.name) / str(next(self._numbers))
        folder.mkdir()
        path = store_upload(name, content, folder)
        taken = {name for other, own in self.own.items() if other != kind for name in own}
        label = free_name(path.stem, taken, path.suffix, " ({})")
        self.add(kind, label, path)
        return label

    def hand(self, name: str) -> Hand:
        """The hand of a name; raises what loading it raises, as the next two do."""
        return self._of_name("hand", name, load_hand)

    def obj(self, name: str) -> ObjectModel:
        """The object of a name."""
        return self._of_name("object", name, load_object)

    def scene(self, name: str) -> Scene:
        """The scene of a name."""
        return self._of_name("scene", name, load_scene)

    def add_things(self, name: str) -> dict[str, str]:
        """Name each thing of a cloud that is a scene, as an object, and all else, as a scene: the two names of each.

        There are none where the scene is a mesh, or shows one thing or none.
        """
        scene = self.scene(name)
        if scene.sight is None or scene.segments.count < 2:
            return {}
        names: dict[str, str] = {}
        for k in range(scene.segments.count):
            found = scene.object_at(scene.spot(k), name=f"thing {k + 1} of {name}")
            names[found.obj.name] = rest = f"all but {found.obj.name}"
            self.add("object", found.obj.name, found.obj)
            if found.obstacles is not None:
                self.add("scene", rest, found.obstacles)
        return names

    def _of_name(self, kind: Kind, name: str, load: Callable[[Any], Any]) -> Any:
        if name not in self.names(kind):  # a name from elsewhere could be the path of any file
            raise OptionError(f"no {kind} is called '{name}' here; pick one of the list")
        source = self.own[kind].get(name, name)
        if isinstance(source, str | Path):
            return self.loaded(kind, name, lambda: load(source))
        return self.loaded(kind, name, source) if callable(source) else source

    def loaded(self, kind: Kind, key: Hashable, load: Callable[[], Any]) -> Any:
        """What is kept under a key, which is loaded where nothing is."""
        kept = self._loaded[kind]
        if (value := kept.get(key)) is None:
            value = kept[key] = load()
        return value

    def plain(self, text: str) -> str:
        """A message without the folders in which uploads lie."""
        return re.sub(re.escape(self.folder.name) + r"/\d+/", "", text)


MAX_BYTES = 20_000_000  # Largest upload [bytes]
MAX_UNPACKED = 100_000_000  # Largest unpacked content of a ZIP file [bytes]
LONGEST_NAME = 200  # Longest file name [bytes]; file systems take 255, and some is left for what is made beside a file
MAX_FILES = 1_000  # Most files in a ZIP file
DESCRIPTIONS = (".urdf", ".xml", ".mjcf")  # Suffixes of hand descriptions


def store_upload(name: str, content: bytes, folder: Path) -> Path:
    """Write an upload into an empty folder, and return its path or, for a ZIP file, that of the hand description in it.

    Args:
        name: File name as it was sent; folders in it are ignored.

    Raises:
        OptionError: The file is too large, its name is invalid, a ZIP file holds no description or paths outside itself, or a
            description names files that were not uploaded with it.
        HandError: A description is not valid XML.
    """
    plain = PurePosixPath(name.replace("\\", "/")).name
    if not plain or plain in {".", ".."} or "\0" in plain or len(plain.encode()) > LONGEST_NAME:
        raise OptionError(f"'{plain[:80]}' is not a file name; give one of 1 to {LONGEST_NAME} bytes")
    if len(content) > MAX_BYTES:
        raise OptionError(f"{plain} has {len(content) / 1e6:.0f} MB, the limit is {MAX_BYTES / 1e6:.0f} MB; use the command "
                          "line for larger files")
    if not plain.lower().endswith(".zip"):
        (folder / plain).write_bytes(content)
        _confine(folder)
        return folder / plain
    _unpack(plain, content, folder)
    _confine(folder)
    found = sorted((p for p in folder.rglob("*") if p.suffix.lower() in DESCRIPTIONS), key=lambda p: (len(p.parts), p))
    urdf = [p for p in found if p.suffix.lower() == ".urdf"]
    if not found:
        raise OptionError(f"{plain} holds no URDF or MJCF file; pack a hand's description together with its meshes, and send "
                          "an object or a scene as one file that is not packed")
    return (urdf or found)[0]


def _confine(folder: Path) -> None:
    """Refuse descriptions that read, or look for, files outside their folder; the folder is refused as a whole."""
    for path in (p for p in folder.rglob("*") if p.suffix.lower() in (*DESCRIPTIONS, ".srdf")):
        for element in parse_xml(path).iter():
            if element.tag in {"include", "model"}:
                raise OptionError(f"{path.name} has <{element.tag}>, which uploads may not; give one file without")
            for name in (value for key, value in element.items() if key.startswith("file") or key.endswith("dir")):
                found = find_mesh(name, path.parent)
                inside = found is None or found.is_relative_to(folder.resolve())
                if not inside or name.startswith(("/", "\\", "~")) or ".." in PurePosixPath(name.replace("\\", "/")).parts:
                    raise OptionError(f"{path.name} names '{name}', which was not uploaded with it; pack both into a ZIP "
                                      "file, and name it by a path within")


def _unpack(name: str, content: bytes, folder: Path) -> None:
    with reading(name, OptionError, "a ZIP file, whole; pack it again"), zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries, left = archive.infolist(), MAX_UNPACKED
        size = sum(entry.file_size for entry in entries)
        if size > MAX_UNPACKED or len(entries) > MAX_FILES:
            raise OptionError(f"{name} unpacks to {len(entries)} files of {size / 1e6:.0f} MB, the limits are {MAX_FILES} "
                              f"files and {MAX_UNPACKED / 1e6:.0f} MB")
        for entry in entries:
            target = folder / entry.filename
            if entry.filename.startswith("/") or ".." in PurePosixPath(entry.filename.replace("\\", "/")).parts:
                raise OptionError(f"{name} holds '{entry.filename}', which lies outside the archive; pack it again")
            if entry.is_dir():
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(entry) as source:  # the sizes listed in a ZIP file may be false
                data = source.read(left + 1)
            left -= len(data)
            if left < 0:
                raise OptionError(f"{name} unpacks to more data than it declares; pack it again")
            target.write_bytes(data)
