"""Files that hold more than a hand: where the hands begin in a whole robot, and how to ask for one of them."""

from __future__ import annotations

from collections.abc import Sequence

from dro_grasp.descriptions.part import named
from dro_grasp.errors import HandError
from dro_grasp.hands.anatomy import path_to
from dro_grasp.kinematics.tree import FIXED, KinematicTree

LONGEST_REACH = 0.45
"""Longest way from a hand's palm along its links to a fingertip [m] (ours). Of the built-in hands, the development assets and
thirty published ones, the longest is 0.23; arms begin at 0.5."""
LONGEST_JAW = 0.2
"""The same where there is a single fingertip [m] (ours): 0.03 to 0.05 for the jaws of SO-100, SO-101, Z1 and
Talos; the smallest arm that was seen, Koch's, has 0.34."""
MOST_NAMED = 6
"""Most hands that an error names (ours)."""


def reach(tree: KinematicTree, above: int, below: int) -> float:
    """The way along the links from one down to another [m]."""
    links = sorted(set(path_to(tree, below)) - set(path_to(tree, above)))
    return float(tree.origin[links, :3, 3].norm(dim=-1).sum())


def find_hands(tree: KinematicTree, tips: Sequence[int]) -> list[int]:
    """The palms of a whole robot: the links all of whose fingertips, two at least, are near, and above which that ends."""
    found: list[int] = []
    for link in range(tree.n_links):
        own = [tip for tip in tips if tip != link and bool(tree.descends[tip, link])]
        together = len(own) > 1 and max(tree.descends[own].all(0).nonzero()[:, 0].tolist()) == link
        if together and not tree.descends[link, found].any() and all(reach(tree, link, tip) < LONGEST_REACH for tip in own):
            found.append(link)
    return found


def require_one_hand(tree: KinematicTree, tips: Sequence[int], palm: int, file: str) -> None:
    """Refuse a whole robot, of which nobody could say what its hand is.

    Raises:
        HandError: It has several hands, or one beside other moving ends, or arms alone; the message says how to ask for one.
    """
    hands = find_hands(tree, tips)
    if hands and not bool(tree.descends[list(tips), hands[0]].all()):
        more = ", ..." if len(hands) > MOST_NAMED else ""
        given = ", ".join(named(file, tree.link_names[hand]) for hand in hands[:MOST_NAMED])
        raise HandError(f"this is a whole robot; give the hand that you want: {given}{more}")
    longest = LONGEST_REACH if len(tips) > 1 else LONGEST_JAW
    far = [tip for tip in tips if reach(tree, palm, tip) > longest]
    if far and not hands:
        carriers = [tree.parent[max(link for link in path_to(tree, tip) if tree.kind[link] != FIXED)] for tip in far]
        given = " or ".join(named(file, tree.link_names[carrier]) for carrier in dict.fromkeys(carriers[:MOST_NAMED]))
        what = "this is an arm" if len(tips) == 1 else "these are arms or legs"
        raise HandError(f"its fingertip '{tree.link_names[far[0]]}' is {reach(tree, palm, far[0]):.2g} m of links away from "
                        f"'{tree.link_names[palm]}', so {what}; if a hand is part of it, name the link at which it begins, "
                        f"for example {given}")
