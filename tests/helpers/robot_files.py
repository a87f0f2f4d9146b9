"""Robot files that tests change."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from dro_grasp.arm.robots.loading import BUILTIN_ROBOTS


def xarm7() -> dict[str, Any]:
    """The built-in xArm 7 with a small hand, with absolute paths."""
    values = yaml.safe_load((BUILTIN_ROBOTS / "xarm7_leaphand.yaml").read_text())
    return values | {"arm": str(BUILTIN_ROBOTS / "xarm7.urdf"), "hand": "gripper3"}


def written(values: dict[str, Any], folder: Path) -> Path:
    """A robot file with these values."""
    path = folder / "robot.yaml"
    path.write_text(yaml.safe_dump(values))
    return path
