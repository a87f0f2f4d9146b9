"""The choice of placement and z: scores against a plain loop, and choices whose answer is known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from dro_grasp.energy.grasp_energy import Room
from dro_grasp.energy.workspace import Surroundings
from dro_grasp.errors import OptionError
from dro_grasp.geometry.balls import Balls
from dro_grasp.geometry.se3 import random_rotations
from dro_grasp.hands.anatomy import PALM
from dro_grasp.hands.hand import Hand
from dro_grasp.models.network import DistanceNetwork, untrained_network
from dro_grasp.models.presets import NetworkConfig
from dro_grasp.objects.catalogue import load_object
from dro_grasp.pipeline import proposal
from dro_grasp.pipeline.choice import CROWDING_POINTS, ChoiceConfig, ChoicePenalties, choice_scores
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.proposal import ProposalConfig, propose
from tests.helpers.loaded_hands import loaded_hand

HAND = loaded_hand("allegro").with_points(160)
SPHERE = load_object("sphere")
CONFIG = ChoicePenalties()


@pytest.fixture(scope="module")
def clouds() -> torch.Tensor:
    """Hands around the sphere, some of them inside it."""
    generator = torch.Generator().manual_seed(0)
    q = HAND.random_joints(12, generator)
    T = torch.eye(4).repeat(12, 1, 1)
    T[:, :3, 3] = -HAND.grasp_centre_wrist + 0.02 * torch.randn(12, 3, generator=generator)
    return HAND.points(q, T).unflatten(0, (3, 4))


def plain_score(points: torch.Tensor) -> float:
    """The score of one hand, by loops over fingers and points."""
    finger = [int(HAND.finger_of_link[link]) for link in HAND.link_index]
    radius = float(torch.as_tensor(SPHERE.cloud).norm(dim=-1).mean())
    distance = [float(p.norm()) - radius for p in points.double()]
    nearest = {f: min(d for d, owner in zip(distance, finger, strict=True) if owner == f) for f in set(finger)}
    tips = [d for f, d in nearest.items() if f != PALM]
    some = [i for i in range(len(points)) if HAND.spread_rank[i] < CROWDING_POINTS and finger[i] != PALM]
    apart = min(float((points[i] - points[j]).norm()) for i in some for j in some if finger[i] != finger[j])
    parts = [math.exp(-max(0.0, d) / CONFIG.nearness) * (owner != PALM) for d, owner in zip(distance, finger, strict=True)]
    mean_normal = sum(part * p / p.norm() for part, p in zip(parts, points, strict=True)) / sum(parts)  # a sphere's normals
    penalties = (
        CONFIG.finger_penetration * sum(max(0.0, CONFIG.margin - d) for d in tips) / len(tips),
        CONFIG.gap * sum(min(max(0.0, d), CONFIG.reach) for d in tips) / len(tips),
        CONFIG.palm_penetration * max(0.0, CONFIG.margin - nearest[PALM]),
        CONFIG.crowding * max(0.0, CONFIG.apart - apart),
        CONFIG.imbalance * float(mean_normal.norm()),
    )
    return -sum(penalties)


def test_scores_agree_with_plain_loops(clouds: torch.Tensor) -> None:
    scores = choice_scores(HAND, SPHERE.distance_field, clouds, CONFIG)
    plain = torch.tensor([[plain_score(cloud) for cloud in row] for row in clouds])
    torch.testing.assert_close(scores, plain, rtol=0.02, atol=0.5)  # the grid knows distances to about 0.3 mm
    assert plain.std() > 1


def test_a_hand_at_the_surface_is_preferred_to_one_inside_and_to_one_far_away() -> None:
    finger = HAND.finger_of_link[HAND.link_index]
    unit = torch.nn.functional.normalize(HAND.points(HAND.canonical_joints()) - HAND.grasp_centre_wrist, dim=-1)
    radius = torch.as_tensor(SPHERE.cloud).norm(dim=-1).mean()
    at, inside, far = ((radius + gap) * unit for gap in (0.002, -0.01, 0.02))
    free = replace(CONFIG, crowding=0.0)
    scores = choice_scores(HAND, SPHERE.distance_field, torch.stack([at, inside, far]), free)
    assert int(scores.argmax()) == 0
    one_in = at.clone()
    one_in[finger == 1] = inside[finger == 1]
    worse = choice_scores(HAND, SPHERE.distance_field, torch.stack([at, one_in, inside]), free)
    assert bool((worse.diff() < 0).all())


def test_a_hand_under_a_plane_is_worse_by_its_depth(clouds: torch.Tensor) -> None:
    free = choice_scores(HAND, SPHERE.distance_field, clouds, CONFIG)
    plane = Surroundings(torch.tensor([0.0, 0.0, 1.0, -0.09]))
    above = choice_scores(HAND, SPHERE.distance_field, clouds, CONFIG, Room(plane))
    depth = (CONFIG.margin - (clouds[..., 2].amin(-1) + 0.09)).clamp_min(0)
    torch.testing.assert_close(free - above, CONFIG.clearance * depth)
    assert 0 < int((depth > 0).sum()) < depth.numel()


def test_fingers_at_the_place_to_hold_are_preferred() -> None:
    unit = torch.nn.functional.normalize(HAND.points(HAND.canonical_joints()) - HAND.grasp_centre_wrist, dim=-1)
    radius = torch.as_tensor(SPHERE.cloud).norm(dim=-1).mean()
    at = (radius + 0.002) * unit
    tip = at[HAND.finger_of_link[HAND.link_index] == 0].mean(0).tolist()
    away = [-x for x in tip]
    there, elsewhere = (
        choice_scores(HAND, SPHERE.distance_field, at, CONFIG, Room(hold=Balls.of(((*place, 0.03),))))  # type: ignore[arg-type]
        for place in (tip, away))
    assert float(there) > float(elsewhere)


def test_the_moved_hands_are_judged_in_the_object_s_frame_and_the_best_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    network = untrained_network(NetworkConfig.preset("multi"), seed=0).eval()
    with torch.no_grad():
        network.motion.last.weight.zero_()
        network.motion.last.bias.zero_()  # nothing moves: the judged points are those of the placed hand
    T = torch.eye(4).repeat(12, 1, 1)
    T[:, :3, :3], T[:, :3, 3] = random_rotations(12, torch.Generator().manual_seed(1)), torch.tensor([0.1, 0.2, -0.3])
    joints = torch.stack([HAND.canonical_joints(share) for share in torch.linspace(0.6, 0.9, 6).tolist()])
    monkeypatch.setattr(proposal, "_placements", lambda *args: T[: args[4] * args[5]].unflatten(0, args[4:6]))
    monkeypatch.setattr(type(HAND), "random_open_joints", lambda *_: joints)
    judged, placed, kept = [], [], []

    def scores(hand: Hand, field: object, points: torch.Tensor, penalties: ChoicePenalties, room: object) -> torch.Tensor:
        judged.append(points)
        draw, second = torch.arange(points.shape[1]).remainder(6).float(), torch.arange(len(points)).remainder(2)
        return draw - 10 * (1 - second[:, None])  # the fifth draw of every second placement is the best

    def head(psi_hand: torch.Tensor, psi_object: torch.Tensor, z: torch.Tensor, *clouds: torch.Tensor) -> torch.Tensor:
        kept.append(z)
        placed.append(clouds[0])
        return plain(psi_hand, psi_object, z, *clouds)

    plain, network._distances = network._distances, head
    network.prior, network.condition = None, None  # z is the draw itself
    monkeypatch.setattr(proposal, "choice_scores", scores)
    problem = GraspProblem(loaded_hand("allegro"), SPHERE)
    with torch.no_grad():
        for choice in (ChoiceConfig.first(), ChoiceConfig(placements=2, draws=8)):
            propose(problem, network, 6, torch.Generator().manual_seed(0), ProposalConfig(choice=choice))
    points = torch.cat(judged)
    assert points.shape[:2] == (12, 8)  # nothing is judged where there is one draw
    expected = HAND.points(joints.repeat_interleave(2, 0), T)
    torch.testing.assert_close(points, expected[:, None].expand_as(points), atol=1e-5, rtol=1e-4)
    first, chosen = (torch.cat(part) for part in (kept[:2], kept[2:]))
    assert first.shape == chosen.shape == (6, network.config.latent)
    drawn = network.sample_latent(12 * 8, _after_cloud(network)).unflatten(0, (6, 2, 8))
    torch.testing.assert_close(chosen, drawn[:, 1, 5])
    cloud = problem.cloud(network.config.n_object, torch.Generator().manual_seed(0))
    second = (expected[1::2] - cloud.mean(0)) @ (T[1::2, :3, :3] @ network.config.axes(HAND.palm_axes_wrist))
    torch.testing.assert_close(torch.cat(placed[2:]), second, atol=1e-5, rtol=1e-4)


def test_fingers_on_one_side_are_worse_than_fingers_around() -> None:
    finger = HAND.finger_of_link[HAND.link_index]
    unit = torch.nn.functional.normalize(torch.randn(2, HAND.n_points, 3, generator=torch.Generator().manual_seed(2)), dim=-1)
    unit[0, :, 2] = unit[0, :, 2].abs()  # all on one half of the sphere
    radius = torch.as_tensor(SPHERE.cloud).norm(dim=-1).mean()
    alone = replace(CONFIG, crowding=0.0, gap=0.0)
    one_side, around = choice_scores(HAND, SPHERE.distance_field, (radius + 0.004) * unit, alone)
    means = [row[finger != PALM].mean(0).norm() for row in unit]
    torch.testing.assert_close(around - one_side, CONFIG.imbalance * (means[0] - means[1]), rtol=0.05, atol=0)
    assert around - one_side > 0.3 * CONFIG.imbalance
    far = choice_scores(HAND, SPHERE.distance_field, 1000 * unit, replace(alone, finger_penetration=0.0, palm_penetration=0.0))
    assert not far.any(), "fingers that are nowhere near push nothing"


@pytest.mark.parametrize("wrong", [{"draws": 0}, {"placements": -1}])
def test_less_than_one_draw_is_refused(wrong: dict[str, int]) -> None:
    (name, value), = wrong.items()
    with pytest.raises(OptionError, match=f"{name} is {value}; draw at least one"):
        ChoiceConfig(**wrong)


def _after_cloud(network: DistanceNetwork) -> torch.Generator:
    """The generator as `propose` leaves it to the draws of z, with placements and joints given."""
    generator = torch.Generator().manual_seed(0)
    SPHERE.sample_points(network.config.n_object, generator)
    return generator
