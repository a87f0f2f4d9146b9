"""The map of rooms in the documents: the layers of import-linter, with the first sentence of each package or module.

    python scripts/draw_rooms.py docs/pictures/rooms.png

Reads pyproject.toml and the sources; needs matplotlib.
"""

from __future__ import annotations

import ast
import sys
import textwrap
import tomllib
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
from matplotlib.patches import FancyBboxPatch

ROOT = Path(__file__).parents[1]
"""Folder of the repository."""
SHADES = ("#dbe9f6", "#e8f1e4", "#fbeedb", "#f3e4ef")
"""Colours of the layers, in turn."""
ARROW = "#555555"
"""Colour of the arrow that shows the direction of imports."""
WIDTH = 11.0
"""Width of the picture [inch]."""
HEIGHT = 0.5
"""Height of a layer [inch]."""


def layers() -> list[list[str]]:
    """Rooms of each layer, the highest first; `__main__` is left out."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    stated = next(contract for contract in settings if contract["type"] == "layers")["layers"]
    found = [[room.strip() for room in layer.replace(":", "|").split("|")] for layer in stated]
    return [rooms for rooms in found if rooms != ["__main__"]]


def purpose(room: str) -> str:
    """First sentence of a room's docstring."""
    folder = ROOT / "src" / "dro_grasp" / room
    source = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
    text = ast.get_docstring(ast.parse(source.read_text())) or ""
    return text.split("\n\n")[0].replace("\n", " ").split(". ")[0].rstrip(".").replace("`", "")


def draw(path: Path) -> None:
    """One band for each layer, one box for each room in it, an arrow for the direction of imports."""
    rows = layers()
    height = HEIGHT * len(rows)
    figure, axes = plt.subplots(figsize=(WIDTH, height + 0.2))
    axes.set_xlim(0, WIDTH)
    axes.set_ylim(0, height)
    axes.axis("off")
    left, right = 0.55, WIDTH - 0.1
    for i, rooms in enumerate(rows):
        bottom, width = height - HEIGHT * (i + 1), (right - left) / len(rooms)
        for j, room in enumerate(rooms):
            axes.add_patch(FancyBboxPatch(
                (left + j * width + 0.05, bottom + 0.06), width - 0.1, HEIGHT - 0.12, boxstyle="round,pad=0.01",
                facecolor=SHADES[i % len(SHADES)], edgecolor="#888888", linewidth=0.6))
            middle, name_width = bottom + HEIGHT / 2, 0.4 + 0.1 * len(room)
            axes.text(left + j * width + 0.15, middle, room, va="center", fontsize=10, weight="bold", family="monospace")
            lines = textwrap.wrap(purpose(room), width=int(14.2 * (width - name_width - 0.15)), max_lines=2, placeholder=" …")
            axes.text(left + j * width + name_width, middle, "\n".join(lines), va="center", fontsize=7.5, color="#333333")
    style = {"arrowstyle": "-|>", "color": ARROW, "lw": 1.4}
    axes.annotate("", xy=(0.28, 0.1), xytext=(0.28, height - 0.1), arrowprops=style)
    axes.text(0.16, height / 2, "imports point downwards only", rotation=90, va="center", ha="center", fontsize=9, color=ARROW)
    figure.savefig(path, dpi=110, bbox_inches="tight", pad_inches=0.05)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
