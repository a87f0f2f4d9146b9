"""From a description to a Hand: points, fingertips, palm, open ends, all derived.

Source: paper section III-B and appendix, dataset preprocessing.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from dro_grasp.descriptions.loader import Description
from dro_grasp.errors import HandError
from dro_grasp.geometry.point_clouds import farthest_points
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.palm import CLOSINGS, Palm, find_palm
from dro_grasp.hands.surface import LinkSurface, sample_links
from dro_grasp.kinematics.tree import FIXED, KinematicTree

TIP_OFFSET = 0.03
"""Distance of the extra target beyond a fingertip [m]."""
AXIS_ALONG_PALM = 0.75
"""Cosine of the angle to the palm direction below which a joint's axis does not point out of the palm."""
PARALLEL = 0.9
"""Cosine above which two joint axes count as parallel."""
LARGEST_HAND, SMALLEST_HAND = 1.5, 0.02
"""Extents from the palm on, outside of which a hand is not in metres [m]."""
REFINEMENTS = 3
"""How often open ends and palm are derived from each other."""


def build_hand(description: Description, *, name: str | None = None, seed: int = 0, n_points: int = 512) -> Hand:
    """Derive everything the method needs from a description.

    Args:
        description: From `load_description`.
        name: How the hand is called in files and tables; the file's stem by default.
        seed: Seed of the point sampling; the same seed gives the same points.
        n_points: Points of the whole hand.

    Raises:
        HandError: No finger, no link with a surface, or a size that no hand has.
    """
    tree = description.tree
    shaped = sorted({g.link for g in description.geometry})
    if not shaped:
        raise HandError(f"{description.path} has no visual or collision shape; nothing can be sampled or touch")
    try:
        tips = find_tips(tree, shaped)
    except HandError as error:
        lost = [note.text for note in description.notes if note.level == "warning"]
        raise HandError(f"{description.path}: {error}" + "".join(f"; {text}" for text in lost[:3])) from error
    palm = find_palm_link(tree, tips, shaped)
    below = [link for link in range(tree.n_links) if bool(tree.descends[link, palm])]
    held = _held_joints(tree, palm)
    rest = torch.zeros(tree.n_dof).clamp(tree.lower, tree.upper)
    surface = sample_links(description, [link for link in below if link in shaped], seed)
    _check_size(description, float(np.ptp(surface.posed(tree, rest)[0], axis=0).max()))
    try:
        opening, abduction, found = _open_ends(tree, surface.coarse(), tips, palm, held, rest)
    except HandError as error:
        raise HandError(f"{description.path}: {error}") from error
    T_palm = torch.linalg.inv(tree.forward(rest)[palm])
    to_palm = lambda p: (T_palm[:3, :3] @ torch.tensor(p, dtype=torch.float32) + T_palm[:3, 3])  # noqa: E731
    draft = Hand(
        name=name or description.name, tree=tree, link_points=surface.points, link_normals=surface.normals,
        link_index=surface.link, tips=tips, tip_offsets=_tip_offsets(tree, surface, tips), palm=palm,
        palm_centre=to_palm(found.centre), palm_direction=T_palm[:3, :3] @ torch.tensor(found.direction, dtype=torch.float32),
        grasp_centre=to_palm(found.grasp_centre), opening=opening, movable=~held, rest=rest, abduction=abduction,
        touching=tuple(link for link in below if any(g.link == link and g.collides for g in description.geometry)),
        sha256=description.sha256, description=description,
    )
    return _thin(draft, n_points)


def _check_size(description: Description, size: float) -> None:
    if size > LARGEST_HAND:
        raise HandError(f"{description.path}: the hand is {size:.3g} m large, which looks like millimetres; expected metres: "
                        "scale its origins, shapes and meshes by 0.001")
    if size < SMALLEST_HAND:
        raise HandError(f"{description.path}: the hand is {size:.3g} m large, which looks like another unit than metres; "
                        f"expected {SMALLEST_HAND} to {LARGEST_HAND} m: scale its origins, shapes and meshes")


def find_tips(tree: KinematicTree, shaped: list[int]) -> tuple[int, ...]:
    """Fingertips: below each last moving joint, the deepest link with a shape.

    Raises:
        HandError: No moving joint carries a shape.
    """
    tips = []
    for link in range(tree.n_links):
        if tree.kind[link] == FIXED:
            continue
        group = [i for i in range(tree.n_links) if bool(tree.descends[i, link])]
        solid = [i for i in group if i in shaped]
        moved_further = any(tree.kind[j] != FIXED and j > link for i in solid for j in _chain(tree, i))
        if solid and not moved_further:
            tips.append(max(solid, key=lambda i: int(tree.descends[i].sum())))
    if not tips:
        raise HandError("no moving joint of this description carries a shape, so it has no fingertip; give its moving links a "
                        "visual or collision shape")
    return tuple(tips)


def find_palm_link(tree: KinematicTree, tips: tuple[int, ...], shaped: list[int]) -> int:
    """The last common ancestor of the fingertips; with one finger, the link that carries it.

    Where neither it nor anything fixed to it has a shape, the nearest link that it is fixed to and that has one.
    """
    common = torch.stack([tree.descends[t] for t in tips]).all(0).nonzero()[:, 0].tolist()
    palm = max(common)
    while len(tips) == 1 and palm > 0 and any(tree.kind[i] != FIXED for i in _chain(tree, palm)):
        palm = tree.parent[palm]
    candidate = palm
    while not any(_rigid_to(tree, i, candidate) for i in shaped):
        if candidate == 0 or tree.kind[candidate] != FIXED:
            return palm
        candidate = tree.parent[candidate]
    return candidate


def _chain(tree: KinematicTree, link: int) -> list[int]:
    return tree.descends[link].nonzero()[:, 0].tolist()


def _held_joints(tree: KinematicTree, palm: int) -> torch.Tensor:
    """Mask (n_dof) of joints that move the palm itself."""
    above = tree.link_coupling[_chain(tree, palm)].abs().sum(0)
    return above > 0


def _open_ends(
    tree: KinematicTree, surface: LinkSurface, tips: tuple[int, ...], palm: int, held: torch.Tensor, rest: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, Palm]:
    """Which end of each joint opens the hand, which joints only spread, and the palm; refined together.

    The open end of a joint is the one at which its fingertips are farther from the grasp centre, with all other
    joints straight or half closed. A joint whose axis points out of the palm, be
    the hand straight or bent, only spreads.
    """
    straight = torch.where(held, rest, torch.zeros(tree.n_dof).clamp(tree.lower, tree.upper))
    centre = torch.tensor(surface.posed(tree, (tree.lower + tree.upper) / 2)[0].mean(0))
    on_palm = _on_palm(tree, surface, palm)
    middle = torch.tensor(surface.posed(tree, straight)[0][on_palm].mean(0))
    opening = -torch.ones(tree.n_dof)
    abduction = torch.zeros(tree.n_dof, dtype=torch.bool)
    out_of_palm = torch.zeros(tree.n_dof, dtype=torch.bool)
    found: Palm | None = None
    for _ in range(REFINEMENTS):
        before = torch.cat([opening, abduction])
        bases = (straight, _half_closed(tree, opening, abduction, held, rest))
        found_ends = [
            [_closing_gain(tree, surface, tips, centre, middle, base, j) for base in bases] for j in range(tree.n_dof)
        ]
        for j, ends in enumerate(found_ends):
            abduction[j] = bool(out_of_palm[j])
            opening[j] = -1.0 if sum(ends) >= 0 or abduction[j] else 1.0
        if found is None or not torch.equal(before, torch.cat([opening, abduction])):
            found = _examine(tree, surface, tips, palm, opening, abduction, held, rest)
        centre = torch.tensor(found.grasp_centre, dtype=torch.float32)
        direction = torch.tensor(found.direction, dtype=torch.float32)
        bent = _half_closed(tree, opening, torch.zeros_like(abduction), held, rest)
        out_of_palm = _axes_along(tree, straight, direction) & _axes_along(tree, bent, direction)
    assert found is not None
    return opening, abduction & ~held, found


def _half_closed(
    tree: KinematicTree, opening: torch.Tensor, abduction: torch.Tensor, held: torch.Tensor, rest: torch.Tensor,
    share: float = 0.5,
) -> torch.Tensor:
    """Joints this share of the way from open to closed; those that only spread near zero."""
    opened = torch.where(opening > 0, tree.upper, tree.lower)
    closed = torch.where(opening > 0, tree.lower, tree.upper)
    neutral = torch.zeros(tree.n_dof).clamp(tree.lower, tree.upper)
    q = torch.where(abduction, neutral, opened + share * (closed - opened))
    return torch.where(held, rest, q)


def _axes_along(tree: KinematicTree, q: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """Mask (n_dof) of the joints whose axes are along a direction of the root frame and which bend nothing.

    A joint with a parallel one below it, or with none below it, is part of a finger's flexion.
    """
    angular = tree.motion_axes(tree.forward(q))[1]
    moving = [i for i in range(tree.n_links) if tree.kind[i] != FIXED]
    along = torch.zeros(tree.n_links, dtype=torch.bool)
    for link in moving:
        below = [i for i in moving if i != link and bool(tree.descends[i, link])]
        parallel = any(float((angular[i] @ angular[link]).abs()) > PARALLEL for i in below)
        along[link] = bool(below) and not parallel and float((angular[link] @ direction).abs()) > AXIS_ALONG_PALM
    return torch.stack([along[tree.link_coupling[:, j].abs() > 0].all() for j in range(tree.n_dof)])


def _closing_gain(
    tree: KinematicTree, surface: LinkSurface, tips: tuple[int, ...], centre: torch.Tensor, middle: torch.Tensor,
    straight: torch.Tensor, j: int,
) -> float:
    """How much nearer the upper end of joint j brings its fingertips than the lower end [m].

    Nearer to the centre and to the palm's middle, added. The centre tells closing from spreading; but curled fingers
    pass it, while they come nearer to the palm all the way.
    """
    moved = [t for t in tips if float(tree.link_coupling[_chain(tree, t), j].abs().sum()) > 0]
    if not moved:
        return 0.0
    middles = [surface.points[surface.link == t].mean(0) for t in moved]
    q = straight.repeat(2, 1)
    q[:, j] = torch.stack([tree.lower[j], tree.upper[j]])
    T = tree.forward(q)
    path = torch.stack([(T[:, t, :3, :3] @ m) + T[:, t, :3, 3] for t, m in zip(moved, middles, strict=True)], 1)
    distance = (path - centre).norm(dim=-1).mean(1) + (path - middle).norm(dim=-1).mean(1)
    return float(distance[0] - distance[1])


def _examine(
    tree: KinematicTree, surface: LinkSurface, tips: tuple[int, ...], palm: int, opening: torch.Tensor,
    abduction: torch.Tensor, held: torch.Tensor, rest: torch.Tensor,
) -> Palm:
    """The palm at the closing where palm and fingers enclose a ball best, in the frame of the root link."""
    rigid, on_palm = _palm_links(tree, palm), _on_palm(tree, surface, palm)
    fingers = [torch.isin(surface.link, torch.tensor([i for i in _chain(tree, t) if i not in rigid])).numpy() for t in tips]
    best: Palm | None = None
    for share in CLOSINGS:
        points, normals = surface.posed(tree, _half_closed(tree, opening, abduction, held, rest, share))
        palm_found = find_palm(points[on_palm], normals[on_palm], [points[f] for f in fingers])
        if best is None or palm_found.score > best.score:
            best = palm_found
    assert best is not None
    return best


def _palm_links(tree: KinematicTree, palm: int) -> list[int]:
    return [i for i in range(tree.n_links) if _rigid_to(tree, i, palm)]


def _on_palm(tree: KinematicTree, surface: LinkSurface, palm: int) -> np.ndarray:
    """Mask of the samples on the palm; all of them where it has none."""
    mask = torch.isin(surface.link, torch.tensor(_palm_links(tree, palm))).numpy()
    return mask if mask.any() else np.ones(len(mask), bool)


def _rigid_to(tree: KinematicTree, link: int, palm: int) -> bool:
    """Whether a link is fixed to the palm."""
    if not bool(tree.descends[link, palm]):
        return False
    while link != palm:
        if tree.kind[link] != FIXED:
            return False
        link = tree.parent[link]
    return True


def _tip_offsets(tree: KinematicTree, surface: LinkSurface, tips: tuple[int, ...]) -> torch.Tensor:
    """Beyond each fingertip along the direction from its last joint through the middle of its surface."""
    poses = tree.forward(torch.zeros(tree.n_dof).clamp(tree.lower, tree.upper))
    offsets = []
    for tip in tips:
        joint_link = max(i for i in _chain(tree, tip) if tree.kind[i] != FIXED)
        middle = surface.points[surface.link == tip].mean(0)
        T = torch.linalg.inv(poses[tip]) @ poses[joint_link]
        origin = T[:3, 3] + T[:3, :3] @ tree.anchor[joint_link]
        along = middle - origin
        offsets.append(middle + TIP_OFFSET * along / along.norm().clamp(min=1e-6))
    return torch.stack(offsets)


def _thin(draft: Hand, n_points: int) -> Hand:
    """Farthest point sampling over the open hand, grouped by link."""
    keep = farthest_points(draft.points(draft.canonical_joints()), n_points).sort().values
    return dataclasses.replace(draft, link_points=draft.link_points[keep], link_normals=draft.link_normals[keep],
                               link_index=draft.link_index[keep])
