"""A report on a hand description: the derived facts and the faults, in words and in a picture."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dro_grasp.files import check_output, replacing
from dro_grasp.geometry.point_clouds import enclosed_volume
from dro_grasp.geometry.rendering.rasterizer import Camera, Mesh, arrow, render
from dro_grasp.hands.anatomy import PALM, Finger
from dro_grasp.hands.build import LONGEST_REACH, build_hand, reach
from dro_grasp.hands.closing import fixed_jaw_of
from dro_grasp.hands.confidence import LOW, confidence, thumb_confidence
from dro_grasp.hands.description.compiling import Note, in_lines
from dro_grasp.hands.description.loader import Description, named, self_penetration
from dro_grasp.hands.doubts import filled_up, only_drawn
from dro_grasp.hands.effort import effort_notes, find_efforts
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.kinematics.tree import PRISMATIC, KinematicTree
from dro_grasp.hands.library import load_hand_description
from dro_grasp.hands.names import named_side
from dro_grasp.hands.opening import FingerMotion, opening_notes
from dro_grasp.hands.usable_range import range_notes

TILE = (560, 520)  # Width and height of one view [pixels]
COLOURS = {"contact": (0.93, 0.66, 0.30), "other": (0.62, 0.66, 0.72), "direction": (0.85, 0.15, 0.15),
           "track": (0.15, 0.39, 0.92), "left out": (0.62, 0.30, 0.75)}
"""Of contact links, links that cannot touch anything, the palm direction, the fingertips' tracks and what they leave out."""
DOUBT = (200, 20, 20)  # Colour of what a picture says of low confidence
SIDEWAYS = 0.15
"""Cosine below which a thumb is on neither side of the other fingers (ours); hands with a side have 0.34 to 0.96."""
FEWEST_WITH_SIDE = 3  # Hands with fewer fingers are on no side, whatever they are called (ours)
CLOSINGS = 41  # Postures from open to closed at which jaws are looked at (ours)
MEETING = 0.003  # How far jaws may slide into each other, as soft ones are made to [m] (ours)
SAME_WAY = 0.9  # Cosine from which on jaws move the same way (ours)
END = {1: "upper", -1: "lower"}  # Limit at which a joint is open, by opening sign
THIN_VOLUME = 1e-9  # Volume below which a link's shapes enclose nothing [m^3] (ours)


@dataclass(frozen=True)
class HandReport:
    """Everything `dro-grasp hand check` says."""

    hand: Hand
    facts: dict[str, Any]
    """Derived facts, by name."""
    notes: tuple[Note, ...]
    """Findings, repairs and faults."""

    def __repr__(self) -> str:
        count = Counter(note.level for note in self.notes)
        found = ", ".join(f"{n} {level}{'s' * (n > 1)}" for level, n in count.items()) or "nothing wrong was found"
        return f"HandReport({self.hand!r}, {found}; lines() tells all)"

    def lines(self) -> list[str]:
        """The report for people."""
        width = max(len(name) for name in self.facts)
        told = []
        for name, value in self.facts.items():
            first, *more = _words(value)
            told.append(f"{name.replace('_', ' '):<{width}}  {first}")
            told.extend(f"{'':<{width}}  {line}" for line in more)
        return [f"hand {self.hand.name}", *told, "", *(in_lines(self.notes) or ["nothing wrong was found"])]

    def to_dict(self) -> dict[str, Any]:
        """The report for programs."""
        notes = [{"level": n.level, "subject": n.subject, "text": n.text} for n in self.notes]
        ends = {joint: END[sign] for joint, sign in self.facts["opening_signs"].items()}
        return {"hand": self.hand.name, **self.facts, "open_ends": ends, "notes": notes}


def check_hand(name: str | Path) -> HandReport:
    """Derive a hand and look for faults in its description.

    Args:
        name: A hand's name or file, as for `load_hand`.

    Raises:
        HandError: The description cannot be used at all.
    """
    description, label = load_hand_description(name)
    hand = build_hand(description, name=label)
    found = (*_part_notes(hand, description), *_finger_notes(hand), *_sliding_notes(hand), *_side_notes(hand),
             *opening_notes(hand), *range_notes(hand), *effort_notes(hand), *_shape_notes(hand, description))
    sure, doubts = confidence(hand, description)
    return HandReport(hand, {**_facts(hand, description), "confidence": sure}, (*description.notes, *found, *doubts))


def _facts(hand: Hand, description: Description) -> dict[str, Any]:
    tree = hand.tree
    names = tree.link_names
    couplings = [
        f"{tree.moving_names[c.follower]} = {c.multiplier:g} * {tree.moving_names[c.leader]} + {c.offset:g}"
        if c.leader >= 0 else f"{tree.moving_names[c.follower]} = {c.offset:g}" for c in description.couplings
    ]
    joints, movable, opened = tree.joint_names, hand.movable.tolist(), hand.canonical_joints(1.0).tolist()
    return {
        "file": description.source,
        "wrist_link": hand.wrist_link,
        "palm_link": names[hand.palm],
        "palm_direction": [round(float(x), 3) for x in hand.palm_direction_wrist],
        "fingertips": [names[t] for t in hand.tips],
        "fingers": {names[finger.tip]: _finger_facts(tree, finger) for finger in hand.fingers},
        "thumb": None if hand.thumb is None else names[hand.tips[hand.thumb]],
        "thumb_opposition": {names[t]: round(float(x), 2) for t, x in zip(hand.tips, hand.thumb_opposition, strict=True)},
        "side": hand_side(hand),
        "rigid_groups": _rigid_groups(hand),
        "free_joints": [n for n, m in zip(joints, movable, strict=True) if m],
        "held_joints": [n for n, m in zip(joints, movable, strict=True) if not m],
        "coupled_joints": couplings,
        "opening_signs": {n: int(sign) for n, sign in zip(joints, hand.opening_signs.tolist(), strict=True)},
        "open_posture": {n: round(x, 3) for n, x, m in zip(joints, opened, movable, strict=True) if m},
        "spreading_joints": [n for n, a in zip(joints, hand.abduction.tolist(), strict=True) if a],
        "effort": {n: round(x, 3) for n, x, m in zip(joints, find_efforts(hand).limit.tolist(), movable, strict=True) if m},
        "contact_links": [names[i] for i in hand.contact_links],
        "points": hand.n_points,
        "size_m": [round(float(x), 3) for x in np.ptp(hand.points(hand.canonical_joints()).numpy(), axis=0)],
    }


def _finger_facts(tree: KinematicTree, finger: Finger) -> dict[str, list[str]]:
    """The links of a finger and the joints that move them, followers included."""
    joints = [tree.moving_names[tree.link_joint[link]] for link in finger.links if tree.link_joint[link] >= 0]
    return {"links": [tree.link_names[link] for link in finger.links], "joints": joints}


def _rigid_groups(hand: Hand) -> list[list[str]]:
    """Links that never move against each other, the topmost first; links that stand alone are left out."""
    groups: dict[int, list[str]] = {}
    for name, top in zip(hand.tree.link_names, hand.rigid_group, strict=True):
        groups.setdefault(top, []).append(name)
    return [group for group in groups.values() if len(group) > 1]


def hand_side(hand: Hand) -> str:
    """`left`, `right`, or `none`: by its thumb, or else by the names of its links and its file."""
    return seen_side(hand) or _side_in_names(hand) or "none"


def seen_side(hand: Hand) -> str | None:
    """The side that the thumb is on; None for a hand without a thumb or with fingers all around the palm."""
    if hand.thumb is None or thumb_confidence(hand) < LOW:
        return None
    tips, palm = FingerMotion.of(hand).tips(hand.canonical_joints(1.0)), hand.palm_centre_wrist
    others = torch.cat([tips[: hand.thumb], tips[hand.thumb + 1 :]]).mean(0)
    # With the fingers up and the palm towards the viewer, the thumb of a right hand is on the viewer's right.
    aside = torch.linalg.cross(others - palm, hand.palm_direction_wrist)
    handed = float(torch.nn.functional.cosine_similarity(aside, tips[hand.thumb] - palm, dim=0))
    return None if abs(handed) < SIDEWAYS else "right" if handed > 0 else "left"


def _side_in_names(hand: Hand) -> str | None:
    if len(hand.fingers) < FEWEST_WITH_SIDE:
        return None
    links = [hand.tree.link_names[i] for i in hand.contact_links]
    file = () if hand.description is None or hand.description.link is not None else (hand.description.path.stem,)
    return named_side(links, file)


def _side_notes(hand: Hand) -> list[Note]:
    """Names that tell of another side than the thumb."""
    seen, named_so = seen_side(hand), _side_in_names(hand)
    if seen is None or named_so in (None, seen):
        return []
    return [Note("warning", hand.tree.link_names[hand.palm], f"is that of a {named_so} hand by its names and of a {seen} hand "
                 "by its thumb, which counts. Is the palm direction right?")]


def _part_notes(hand: Hand, description: Description) -> list[Note]:
    """A hand on an arm, whose joints are none of the hand's."""
    tree, palm = hand.tree, hand.tree.link_names[hand.palm]
    if reach(tree, 0, hand.palm) < LONGEST_REACH:
        return []
    return [Note("warning", palm, f"hangs on {int((~hand.movable).sum())} joints that are held at rest, and a grasp's wrist is "
                 f"'{hand.wrist_link}'; for the hand alone give {named(description.path.name, palm)}")]


def _finger_notes(hand: Hand) -> list[Note]:
    """A finger alone closes on nothing but the palm, or on the jaw that is part of it."""
    if len(hand.tips) != 1:
        return []
    tip = hand.tree.link_names[hand.tips[0]]
    if fixed_jaw_of(hand) is not None:
        return [Note("info", tip, f"closes on a jaw that is part of '{hand.tree.link_names[hand.palm]}'")]
    return [Note("warning", tip, "is the only fingertip; it can only press an object against the palm. Is a finger missing?")]


def _sliding_notes(hand: Hand) -> list[Note]:
    """Jaws that all slide the same way hold nothing between them."""
    opened, closed = (FingerMotion.of(hand).tips(hand.canonical_joints(x)) for x in (1.0, 0.0))
    slides = torch.tensor([any(hand.tree.kind[link] == PRISMATIC for link in finger.chain) for finger in hand.fingers])
    if len(hand.fingers) < 2 or not bool(slides.all()):
        return []
    ways = torch.nn.functional.normalize(closed - opened, dim=-1)
    if float((ways @ ways.T).min()) < SAME_WAY:
        return _crossing_notes(hand)
    names = ", ".join(hand.tree.link_names[tip] for tip in hand.tips)
    return [Note("warning", names, "slide the same way when the hand closes, so they hold nothing between them; turn the "
                 "axis of one of their joints, or the sign of its multiplier")]


def _crossing_notes(hand: Hand) -> list[Note]:
    """Jaws whose limits let them slide into each other."""
    if hand.description is None:
        return []
    finger = dict(zip(hand.tree.link_names, hand.finger_of_link.tolist(), strict=True))
    deepest: dict[tuple[str, str], float] = {}
    for share in torch.linspace(1, 0, CLOSINGS):
        for pair, depth in self_penetration(hand.description, hand.canonical_joints(float(share))).items():
            if PALM not in (own := {finger[name] for name in pair}) and len(own) > 1:
                deepest[pair] = max(depth, deepest.get(pair, 0.0))
    return [Note("warning", ", ".join(pair), f"slide into each other by {depth * 1000:.0f} mm when the hand closes; state "
                 "limits at which they meet") for pair, depth in deepest.items() if depth > MEETING]


def _shape_notes(hand: Hand, description: Description) -> list[Note]:
    own = hand.tree.descends[:, hand.palm].nonzero()[:, 0].tolist()  # the palm and what hangs on it
    notes = [*only_drawn(description, own), *filled_up(description)]
    for link in own:
        shapes = [g for g in description.geometry if g.link == link]
        volume = sum(abs(enclosed_volume(g.vertices[g.faces])) for g in shapes)
        if shapes and volume < THIN_VOLUME:
            notes.append(Note("warning", hand.tree.link_names[link], "has shapes without volume"))
    few = [hand.tree.link_names[i] for i in hand.link_index.unique().tolist() if not bool(hand.registrable[i])]
    return [*notes, *(Note("info", name, "has too few points for a pose of its own; its neighbours place it") for name in few)]


def _words(value: Any) -> list[str]:
    if isinstance(value, dict) and any(isinstance(v, dict) for v in value.values()):
        return [f"{tip} (links {', '.join(v['links'])}; joints {', '.join(v['joints'])})" for tip, v in value.items()]
    if isinstance(value, dict):
        return [", ".join(f"{k} {v:+d} ({END[v]})" if isinstance(v, int) else f"{k} {v}" for k, v in value.items())]
    if isinstance(value, list):
        return [", ".join(" + ".join(v) if isinstance(v, list) else str(v) for v in value) or "none"]
    return ["none" if value is None else str(value)]


def picture(hand: Hand, path: Path | str) -> None:
    """Draw the hand, which needs its description, open and closed; OutputError: the PNG cannot be written."""
    from PIL import Image, ImageDraw, ImageFont

    path = check_output(path)
    (width, height), line = TILE, 30  # pixels
    sheet = Image.new("RGB", (2 * width, height + 2 * line), (255, 255, 255))
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(15)
    camera = _camera(hand)
    for column, (title, openness) in enumerate((("open", 1.0), ("three quarters closed", 0.25))):
        sheet.paste(Image.fromarray(render(_meshes(hand, openness), camera, width, height)), (column * width, line))
        pen.text((column * width + 12, 6), f"{hand.name}, {title}", fill=(20, 20, 20), font=font)
    legend = "orange: contact links   grey: others   red: palm direction   blue: the ways of fingertips"
    if not torch.equal(hand.open_ends, hand.open_limits):
        legend += "   purple: left out"
    pen.text((12, height + line + 6), legend, fill=(90, 90, 90), font=font)
    if doubts := _doubts(hand):  # to the right of the legend
        pen.text((2 * width - 12, height + line + 6), f"low confidence: {doubts}", fill=DOUBT, font=font, anchor="ra")
    with replacing(path, "picture") as temporary:
        sheet.save(temporary, format="PNG")


def _doubts(hand: Hand) -> str:
    """What of the hand is read with low confidence, in words."""
    sure, _ = confidence(hand, hand.description) if hand.description else ({}, [])
    return " and ".join({"palm": "palm direction"}.get(name, name) for name, value in sure.items() if value < LOW)


def _camera(hand: Hand) -> Camera:
    """From in front of the palm, a little aside and above."""
    points = torch.cat([hand.points(hand.canonical_joints(x)) for x in (1.0, 0.25)]).numpy()
    front = hand.palm_direction_wrist.numpy()
    up = points.mean(0) - (hand.T_wrist_palm_rest[:3, 3]).numpy()
    up = up - (up @ front) * front
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    side = np.cross(up, front)
    direction = front + 0.75 * side + 0.35 * up
    as_tuple = lambda v: (float(v[0]), float(v[1]), float(v[2]))  # noqa: E731
    return Camera.around(points, as_tuple(direction), as_tuple(up), aspect=TILE[0] / TILE[1])


def _meshes(hand: Hand, openness: float) -> list[Mesh]:
    poses = hand.tree.forward(hand.canonical_joints(openness)).numpy()
    meshes = [
        Mesh(g.vertices @ poses[g.link, :3, :3].T + poses[g.link, :3, 3], g.faces,
             COLOURS["contact" if g.link in hand.contact_links else "other"])
        for g in (hand.description.geometry if hand.description else ())
        if g.visual and bool(hand.tree.descends[g.link, hand.palm])
    ]
    start = hand.palm_centre_wrist.numpy()
    meshes.append(arrow(start, start + 0.1 * hand.palm_direction_wrist.numpy(), COLOURS["direction"], radius=0.003))
    used = torch.stack([hand.canonical_joints(float(x)) for x in torch.linspace(1, 0.25, 8)])
    farthest = torch.where(hand.open_ends == hand.open_limits, used[0], hand.open_limits)
    beyond = torch.stack([torch.lerp(used[0], farthest, float(x)) for x in torch.linspace(0, 1, 12)])
    for colour, joints in (("track", used), ("left out", beyond))[: 1 + (not torch.equal(farthest, used[0]))]:
        for track in FingerMotion.of(hand).tips(joints).transpose(0, 1).numpy():
            meshes.extend(arrow(a, b, COLOURS[colour], radius=0.0012) for a, b in pairwise(track))
    return meshes
