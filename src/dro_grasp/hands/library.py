"""Hands by name or path: built-in, development assets, `robot_descriptions`, or any file."""

from __future__ import annotations

import difflib
import importlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from dro_grasp.errors import HandError
from dro_grasp.files import given_path
from dro_grasp.kinds import checked

if TYPE_CHECKING:
    from dro_grasp.hands.description.loader import Description
    from dro_grasp.hands.hand import Hand

BUILTIN_FOLDER = Path(__file__).parent / "builtin"  # Folder of the built-in descriptions
ASSET_FILES = {
    "barrett": "barrett/bhand_model.urdf",
    "barrett_multidex": "barrett_multidex/model.urdf",
    "allegro_left": "allegro/allegro_hand_left.urdf",
    "allegro_right": "allegro/allegro_hand_right.urdf",
    "shadowhand": "shadowhand/shadow_hand_right.urdf",
    "leaphand": "leaphand/leap_hand_right.urdf",
    "inspire": "inspire/inspire_hand_right.urdf",
    "ability": "ability/ability_hand_right.urdf",
    "dclaw": "dclaw/dclaw_gripper.urdf",
    "orca": "orca/scene_right.xml",
    "ezgripper": "ezgripper/ezgripper.urdf",
}
"""Main file of each development asset, in the assets' hands folder."""
ASSET_PREFIX = "assets/"  # Prefix that forces a name to be that of a development asset


@checked
def load_hand(name: str | Path, *, seed: int = 0, n_points: int = 512) -> Hand:
    """Load a hand by name or from a URDF or MJCF file; nothing needs to be annotated.

    A bare name is a built-in hand first, then one of the development assets (folder `DRO_GRASP_ASSETS`), then a
    `robot_descriptions` module; `assets/NAME` forces the asset. Where a file holds a whole robot, `FILE#LINK` is the hand
    that begins at this link.

    Args:
        name: Name or file.
        seed: Seed of the point sampling.
        n_points: Surface points to keep.

    Raises:
        HandError: No such hand, or its description cannot be used.
        OptionError: The hand cannot have so many points, or so few.
    """
    from dro_grasp.hands.stored import stored_hand  # names of hands are asked for without PyTorch

    description, label = load_hand_description(name)
    return stored_hand(description, label, seed, n_points)


def load_hand_description(name: str | Path) -> tuple[Description, str]:
    """The description of a hand, and the hand's name; derives neither points nor palm."""
    from dro_grasp.hands.description.loader import load_description

    found = locate_hand(name)
    return load_description(found.path, found.link), found.name


def hand_names() -> dict[str, str]:
    """Names that `load_hand` takes, each with its source: `builtin` or `assets`."""
    builtin = {file.stem: "builtin" for file in sorted(BUILTIN_FOLDER.glob("*.urdf"))}
    return builtin | {ASSET_PREFIX + name: "assets" for name in ASSET_FILES if _asset_file(name)}


class HandFile(NamedTuple):
    """Where a hand is described."""

    path: Path  # the file
    name: str  # the hand's name in results
    link: str | None  # the link at which the hand begins; None where the file is the hand's


def locate_hand(name: str | Path) -> HandFile:
    """The file of a hand, and its part; the file need not exist. HandError: no hand has this name."""
    from dro_grasp.hands.description.loader import named, split_part

    text, link = split_part(str(name))
    path, label = _locate(text)
    return HandFile(path, named(label, link), link)


def _locate(text: str) -> tuple[Path, str]:
    path, builtin = given_path(text), BUILTIN_FOLDER / f"{text}.urdf"
    if "/" not in text and os.path.isfile(builtin):
        return builtin, text
    asset = _asset_file(text.removeprefix(ASSET_PREFIX))
    if asset is not None:
        return asset, ASSET_PREFIX + text.removeprefix(ASSET_PREFIX)
    if path.exists() or path.suffix.lower() in {".urdf", ".xml", ".mjcf"}:
        return path, path.stem
    described = _robot_description(text)
    if described is not None:
        return described, text
    raise HandError(_unknown(text))


def _asset_folder() -> Path | None:
    root = os.environ.get("DRO_GRASP_ASSETS")
    return given_path(root) / "hands" if root else None


def _asset_file(name: str) -> Path | None:
    folder = _asset_folder()
    file = folder / ASSET_FILES[name] if folder and name in ASSET_FILES else None
    return file if file and file.is_file() else None


def _robot_description(name: str) -> Path | None:
    """The file of a `robot_descriptions` module; None if that package is not installed or does not know the name."""
    if not name.replace("_", "").isalnum():
        return None
    for module in (name, f"{name}_description", f"{name}_mj_description"):
        try:
            found = importlib.import_module(f"robot_descriptions.{module}")
        except ImportError:
            continue
        except Exception as error:  # importing runs the module of others, and git: it may raise anything
            reason = str(error).strip().splitlines()[-1:] or [type(error).__name__]
            raise HandError(f"robot_descriptions could not fetch '{module}' ({reason[0].strip()}); connect to the network, or "
                            "give the path of a URDF or MJCF file") from error
        file = getattr(found, "URDF_PATH", None) or getattr(found, "MJCF_PATH", None)
        if file is None:
            raise HandError(f"robot_descriptions has '{module}' as neither URDF nor MJCF file; convert it, for example with "
                            "xacro, and give the path of what you get")
        return Path(file)
    return None


def _unknown(name: str) -> str:
    known = hand_names()
    bare = dict.fromkeys(n.removeprefix(ASSET_PREFIX) for n in known)
    near = difflib.get_close_matches(name.removeprefix(ASSET_PREFIX), bare, n=3)
    hint = f" Perhaps you meant {' or '.join(near)}." if near else ""
    missing = ""
    if name.startswith(ASSET_PREFIX) and _asset_folder() is None:
        missing = " Names that begin with assets/ need DRO_GRASP_ASSETS to name the assets folder."
    return (f"no hand is called '{name}'.{hint}{missing} Known: {', '.join(known)}; or give the path of a URDF or MJCF "
            "file, or install `robot_descriptions` and give one of its names")

