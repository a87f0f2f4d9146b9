"""What can be asked for by name: built-in hands and objects, the user's own, and what a browser or a client sends."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Hashable
from functools import cached_property
from itertools import chain, count
from pathlib import Path
from typing import Any, Literal

from cachetools import LRUCache

from dro_grasp.apps.uploads import store_upload
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

        Raises:
            OptionError: The upload is refused.
        """
        folder = Path(self.folder.name) / str(next(self._numbers))
        folder.mkdir()
        path = store_upload(name, content, folder)
        taken = {name for other, own in self.own.items() if other != kind for name in own}
        numbered = (f"{path.stem} ({number}){path.suffix}" for number in count(2))
        label = next(name for name in chain([path.name], numbered) if name not in taken)
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

    def _of_name(self, kind: Kind, name: str, load: Callable[[Any], Any]) -> Any:
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
