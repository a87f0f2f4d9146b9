"""How sure palm and thumb of a hand are: whether cues that do not know of each other agree."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from dro_grasp.hands.anatomy import ABOUT_AS_OPPOSED, FEWEST_WITH_THUMB
from dro_grasp.hands.build import HandBuilder
from dro_grasp.hands.description.compiling import Note
from dro_grasp.hands.description.loader import CLOSED, Description
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.names import named_thumb
from dro_grasp.hands.opening import FingerMotion, guessed_side

LOW = 0.6  # Confidence below which `hand check` warns (ours); palms and thumbs of 16 hands that are read right have more
GUESS = 0.3  # Confidence in the palm's side of a flat hand that closes to either side alike (ours)
NO_PALM = 0.5  # Confidence in the palm of a hand whose palm has no shape, at most (ours)
NEARER = 0.005  # How much nearer to the grasp centre a fingertip must come for that it closes [m] (ours)
BEFORE = 0.01  # How far behind the palm's face fingertips of the half-closed hand may be [m] (ours)
SHARES = 9  # Postures from open to closed at which fingertips are looked for (ours)


@dataclass(frozen=True)
class Cue:
    """One sign that the palm, and the side to which fingers close, are as they were read."""

    share: float  # 1 if it agrees, 0 if it contradicts
    doubt: str  # what it says where it does not agree


def palm_cues(hand: Hand, description: Description) -> list[Cue]:
    """What limits, meeting fingertips and their first motion say of the palm."""
    finder, motion = HandBuilder(description).finder, FingerMotion.of(hand)
    curls, sides = finder.sides
    told = [bool(side) for curl, side in zip(curls, sides, strict=True) if bool(curl.ways.any())]
    tips = motion.tips(torch.stack([hand.canonical_joints(1 - float(x)) for x in torch.linspace(0, 1, SHARES)]))
    targets = torch.cat([tips, hand.grasp_centre_wrist.expand(SHARES, 1, 3)], 1)
    apart = (tips[:, :, None] - targets[:, None]).norm(dim=-1)
    coming = (apart[0] - apart.amin(0) > NEARER).any(-1).float()
    ahead = ((tips[SHARES // 2] - hand.palm_centre_wrist) @ hand.palm_direction_wrist > -BEFORE).float()
    cues = [Cue(sum(told) / len(told) if told else 1.0, "neither limits nor other fingers tell to which side fingers close"),
            Cue(float(coming.mean()), "fingers come nearer neither to each other nor to the middle of what the hand encloses"),
            Cue(float(ahead.mean()), "fingertips of the half-closed hand are behind the palm")]
    if finder.stand_in is not None:
        cues.append(Cue(NO_PALM, "its link has no shape; it is taken to face where fingers point, or begin to close"))
    if finder.sweep is not None:
        along = float(hand.palm_direction_wrist @ torch.from_numpy(finder.sweep).float())
        cues.append(Cue(max(0.0, along), "fingers begin to close in another direction than the palm faces"))
    return cues


def called_thumb(hand: Hand) -> int | None:
    """The finger that is a thumb by its names."""
    return named_thumb([[hand.tree.link_names[link] for link in finger.links] for finger in hand.fingers])


def thumb_confidence(hand: Hand) -> float:
    """How clearly one finger opposes the others, up to 1; 1 where names say the same, or where there is no thumb."""
    if hand.thumb is None or len(hand.fingers) < FEWEST_WITH_THUMB or called_thumb(hand) == hand.thumb:
        return 1.0
    first, second = hand.thumb_opposition.topk(2).values.tolist()
    return min(1.0, max(0.0, first - second) / ABOUT_AS_OPPOSED)


def confidence(hand: Hand, description: Description) -> tuple[dict[str, float], list[Note]]:
    """How sure palm and thumb are, from 0 to 1, and a note on each that is not."""
    cues, palm = palm_cues(hand, description), hand.tree.link_names[hand.palm]
    least, guess = min(cues, key=lambda cue: cue.share), guessed_side(hand) if cues[0].share < 1 else None
    sure = {"palm": round(min(least.share, GUESS if guess else 1.0), 2), "thumb": round(thumb_confidence(hand), 2)}
    notes = [guess] if guess else []
    if not guess and least.share < LOW:
        notes.append(Note("warning", palm, f"has a palm direction of low confidence ({sure['palm']:g}): {least.doubt}. See the "
                          f"picture; if the arrow is wrong, state where joints close: {entry(description)}"))
    tip = None if hand.thumb is None else hand.tree.link_names[hand.tips[hand.thumb]]
    if tip is not None and called_thumb(hand) not in (None, hand.thumb):
        notes.append(Note("warning", tip, "is taken for the thumb, as it opposes the others, and another finger is called so"))
    elif tip is not None and sure["thumb"] < LOW:
        notes.append(Note("info", tip, f"is taken for the thumb with low confidence ({sure['thumb']:g}): another finger "
                          "opposes about as much. One of them whose links are called thumb would be it"))
    return sure, notes


def entry(description: Description) -> str:
    """What to write, and where, for joints to close otherwise."""
    if description.path.suffix == ".xml":
        return f'a <key name="{CLOSED}"> in {description.path.name}'
    return f'a <group_state name="{CLOSED}"> in {description.path.with_suffix(".srdf").name}'
