"""What makes a hand's file doubtful, short, for those who grasp without `dro-grasp hand check`."""

from __future__ import annotations

from collections.abc import Iterable

from dro_grasp.files import command
from dro_grasp.hands.description.compiling import Note, in_lines
from dro_grasp.hands.description.loader import Description

MOST = 3  # Most lines (ours); they are shown beside what a command is for

CONVEX = 0.7  # Share of its hull below which a collision mesh is far from convex (ours); some shells of fingers fill half


def only_drawn(description: Description, links: Iterable[int]) -> list[Note]:
    """A warning for each of these links that cannot touch anything, as it has visual shapes alone."""
    names, collides = description.tree.link_names, {g.link for g in description.geometry if g.collides}
    return [Note("warning", names[link], "has a visual but no collision shape; it cannot touch anything")
            for link in sorted({g.link for g in description.geometry}.intersection(links) - collides)]


def filled_up(description: Description) -> list[Note]:
    """A note on links whose collision meshes are far from convex: MuJoCo collides with their hulls."""
    names, links = description.tree.link_names, {g.link for g in description.geometry if g.fill < CONVEX}
    text = ("taken as the convex hull of its mesh, which fills up what is hollow; where fingers or objects have to go in, give "
            "it several convex collision shapes")
    return [Note("info", ", ".join(names[link] for link in sorted(links)), text)] if links else []


def doubts(description: Description) -> list[str]:
    """Warnings of a hand's file in a few lines, the last of which says where all is told; none for one without faults."""
    moving = description.tree.moves.any(1).nonzero()[:, 0].tolist()
    lines = in_lines([*(note for note in description.notes if note.level == "warning"), *only_drawn(description, moving)])
    more = f"{len(lines) - MOST} more; " if len(lines) > MOST else ""
    return [*lines[:MOST], f"{more}see {command('dro-grasp', 'hand', 'check', description.source)}"] if lines else []
