"""What a page can pick from: hands and objects with a name, uploads, and the hand and objects of a grasp file."""

from __future__ import annotations

import re
import tempfile
from itertools import chain, count
from pathlib import Path

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import object_of
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import hand_names, load_hand
from dro_grasp.objects.catalogue import load_object, object_names
from dro_grasp.objects.scenery import Scene, load_scene
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.web.uploads import store_upload


class Shelf:
    """Hands and objects by the names that people see; each is loaded when it is first picked, and then kept."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="dro-grasp-")
        self._numbers = count(1)
        self._paths: dict[str, Path] = {}
        self._kinds: dict[str, str] = {}
        self._hands: dict[str, Hand] = {}
        self._objects: dict[str, ObjectModel] = {}
        self._scenes: dict[str, Scene] = {}
        self.batches: dict[str, GraspBatch] = {}
        """Grasps of a file, by the name of their object."""

    def close(self) -> None:
        """Delete the uploads."""
        self._folder.cleanup()

    def take(self, name: str, content: bytes, kind: str) -> str:
        """Store an upload, and return the name under which it can be picked.

        An upload replaces the one before of its name and kind; names that another kind has taken get a number.

        Args:
            name: Of the file.
            content: Of the file.
            kind: What it is to be used as: hand, object or scene.

        Raises:
            OptionError: The upload is refused.
        """
        folder = Path(self._folder.name) / str(next(self._numbers))
        folder.mkdir()
        path = store_upload(name, content, folder)
        numbered = (f"{path.stem} ({number}){path.suffix}" for number in count(2))
        label = next(name for name in chain([path.name], numbered) if self._kinds.get(name, kind) == kind)
        self._paths[label], self._kinds[label] = path, kind
        for kept in (self._hands, self._objects, self._scenes, self.batches):
            kept.pop(label, None)
        return label

    def put(
        self, hand: Hand | None = None, grasps: GraspBatch | None = None, obj: ObjectModel | None = None
    ) -> None:
        """Add a hand, an object, or the grasps and the objects of a file; an object, if given, is that of all its grasps."""
        if hand is not None:
            self._hands[hand.name] = hand
        if obj is not None:
            self._objects[obj.name] = obj
        if grasps is not None:
            self.batches |= dict(grasps.by_object()) if obj is None else {obj.name: grasps}

    def hand_names(self) -> tuple[str, ...]:
        """Names of hands, those of a file first."""
        return tuple(dict.fromkeys([*self._hands, *hand_names()]))

    def object_names(self) -> tuple[str, ...]:
        """Names of objects, those of a file first."""
        return tuple(dict.fromkeys([*self.batches, *self._objects, *object_names()]))

    def hand(self, name: str) -> Hand:
        """The hand of a name.

        Raises:
            HandError: It cannot be used.
        """
        if name not in self._hands:
            self._hands[name] = load_hand(self._paths.get(name, name))
        return self._hands[name]

    def obj(self, name: str) -> ObjectModel:
        """The object of a name.

        Raises:
            ObjectError: It cannot be used.
        """
        if name not in self._objects:
            batch = self.batches.get(name)
            self._objects[name] = load_object(self._paths.get(name, name)) if batch is None else object_of(batch, None, 1.0)
        return self._objects[name]

    def scene(self, name: str) -> Scene:
        """The upload of a name, as a scene to avoid.

        Raises:
            ObjectError: It cannot be used.
        """
        if name not in self._scenes:
            self._scenes[name] = load_scene(self._paths[name])
        return self._scenes[name]

    def plain(self, text: str) -> str:
        """A message without the folders in which uploads lie."""
        return re.sub(re.escape(self._folder.name) + r"/\d+/", "", text)
