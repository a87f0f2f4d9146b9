"""The choice of z: scores against a plain loop, and choices whose answer is known."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from dro_grasp import distance_matrix
from dro_grasp.energy.grasp_energy import Room
from dro_grasp.energy.surroundings import Surroundings
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
    penalties = (
        CONFIG.finger_penetration * sum(max(0.0, CONFIG.margin - d) for d in tips) / len(tips),
        CONFIG.gap * sum(min(max(0.0, d), CONFIG.reach) for d in tips) / len(tips),
        CONFIG.palm_penetration * max(0.0, CONFIG.margin - nearest[PALM]),
        CONFIG.crowding * max(0.0, CONFIG.apart - apart),
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
    T = torch.eye(4).repeat(6, 1, 1)
    T[:, :3, :3], T[:, :3, 3] = random_rotations(6, torch.Generator().manual_seed(1)), torch.tensor([0.1, 0.2, -0.3])
    joints = torch.stack([HAND.canonical_joints(share) for share in torch.linspace(0.6, 0.9, 6).tolist()])
    monkeypatch.setattr(proposal, "_placements", lambda *_: T)
    monkeypatch.setattr(type(HAND), "random_open_joints", lambda *_: joints)
    judged, kept = [], []

    def scores(hand: Hand, field: object, points: torch.Tensor, penalties: ChoicePenalties, room: object) -> torch.Tensor:
        judged.append(points)
        return torch.arange(points.shape[1]).remainder(6).float().expand(points.shape[:2])  # the fifth is the best

    def head(psi_hand: torch.Tensor, psi_object: torch.Tensor, z: torch.Tensor, *clouds: torch.Tensor) -> torch.Tensor:
        kept.append(z)
        return plain(psi_hand, psi_object, z, *clouds)

    plain, network._distances = network._distances, head
    network.prior, network.condition = None, None  # z is the draw itself
    monkeypatch.setattr(proposal, "choice_scores", scores)
    with torch.no_grad():
        for draws in (1, 8):
            config = ProposalConfig(choice=ChoiceConfig(draws=draws))
            propose(GraspProblem(loaded_hand("allegro"), SPHERE), network, 6, torch.Generator().manual_seed(0), config)
    points = torch.cat(judged)
    assert points.shape[:2] == (6, 8)  # nothing is judged where there is one draw
    expected = HAND.points(joints, T)[:, None].expand_as(points)
    torch.testing.assert_close(points, expected, atol=1e-5, rtol=1e-4)
    one, many = torch.cat(kept[:2]), torch.cat(kept[2:])
    assert one.shape == many.shape == (6, network.config.latent)
    drawn = network.sample_latent(6, _after_cloud(network), 1.0, 8)
    torch.testing.assert_close(many, drawn[:, 5])


def test_of_several_decoded_hands_the_one_at_the_surface_is_kept() -> None:
    problem = GraspProblem(loaded_hand("allegro"), SPHERE)
    cloud = problem.cloud(128, torch.Generator().manual_seed(0))
    q = HAND.canonical_joints(0.45)
    T = torch.eye(4).repeat(2, 3, 1, 1)  # inside, at the surface and away from it, in two orders
    radius = float(torch.as_tensor(SPHERE.cloud).norm(dim=-1).mean())
    away = HAND.palm_direction_wrist
    for row, order in enumerate(((-2.0, 0.0, 5.0), (0.0, 5.0, -2.0))):
        for k, share in enumerate(order):
            T[row, k, :3, 3] = -HAND.grasp_centre_wrist - share * 0.6 * radius * away
    points = HAND.points(q.expand(2, 3, -1), T)
    distances = distance_matrix.build(points, cloud.expand(2, 3, -1, -1))
    config = ChoiceConfig(decoded=3)
    whole = problem.hand.points(q.expand(2, 3, -1), T)
    wanted = choice_scores(problem.hand, problem.field, whole, config.of_decoded).argmax(-1)
    assert wanted.tolist() == [1, 0]
    found, joints, clouds = proposal._decoded(HAND, distances, cloud, q.expand(2, -1))
    torch.testing.assert_close(found, T, atol=1e-3, rtol=0)
    torch.testing.assert_close(joints, q.expand(2, 3, -1), atol=5e-3, rtol=0)
    torch.testing.assert_close(clouds, points, atol=1e-4, rtol=0)
    assert torch.equal(proposal._best(problem, found, joints, config), wanted)


def test_no_z_and_more_z_than_are_drawn_cannot_be_decoded() -> None:
    for decoded in (0, 5):
        with pytest.raises(OptionError, match=f"decoded is {decoded} of 4 draws"):
            ChoiceConfig(draws=4, decoded=decoded)


def _after_cloud(network: DistanceNetwork) -> torch.Generator:
    """The generator as `propose` leaves it to the draws of z, with placements and joints given."""
    generator = torch.Generator().manual_seed(0)
    SPHERE.sample_points(network.config.n_object, generator)
    return generator
