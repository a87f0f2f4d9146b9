"""The choice of placement and z: scores against a plain loop, and choices whose answer is known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from dro_grasp.errors import OptionError
from dro_grasp.geometry.distance_field import Balls
from dro_grasp.hands.anatomy import PALM
from dro_grasp.network.network import DistanceNetwork, Moves
from dro_grasp.network.presets import NetworkConfig
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.grasp_energy import Surroundings, Workspace
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.choice import CROWDING_POINTS, ChoiceConfig, ChoicePenalties, choice_scores, posed_cloud
from dro_grasp.predict.sources.network import ProposalConfig, propose
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
    above = choice_scores(HAND, SPHERE.distance_field, clouds, CONFIG, Workspace(plane))
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
        choice_scores(HAND, SPHERE.distance_field, at, CONFIG, Workspace(contact_region=Balls.of(((*place, 0.03),))))  # type: ignore[arg-type]
        for place in (tip, away))
    assert float(there) > float(elsewhere)


class Watched(DistanceNetwork):
    """Untrained, and keeps what it is offered and what it decodes."""

    def __init__(self) -> None:
        with torch.random.fork_rng():
            torch.manual_seed(0)
            super().__init__(NetworkConfig.preset("multi"))
        self.offered: list[Moves] = []
        self.decoded: list[Moves] = []
        self.eval()

    def move(self, hand: torch.Tensor, obj: torch.Tensor, noise: torch.Tensor) -> Moves:
        self.offered.append(super().move(hand, obj, noise))
        return self.offered[-1]

    def distances(self, moves: Moves) -> torch.Tensor:
        self.decoded.append(moves)
        return super().distances(moves)


@pytest.mark.parametrize("finalists", [1, 6])
def test_of_all_that_is_offered_for_a_candidate_the_hand_that_suits_the_object_best_is_decoded(finalists: int) -> None:
    network, problem = Watched(), GraspProblem(loaded_hand("allegro"), load_object("mug"))
    config = ProposalConfig(choice=ChoiceConfig(placements=3, draws=2, finalists=finalists), batch_size=4, network_batch_size=2)
    with torch.no_grad():
        made = propose(problem, network, 4, torch.Generator().manual_seed(0), config)
    assert len(made) == 4
    assert [moves.points.shape[:2] for moves in network.offered] == [(6, 2)] * 2, "three placements of each of two, twice"
    cloud = problem.cloud(network.config.n_object, torch.Generator().manual_seed(0))
    thin, chosen = problem.thinned(network.config.n_hand), []
    for offered, decoded in zip(network.offered, network.decoded, strict=True):
        # The network's axes, found from what it is shown of the object.
        axes = torch.linalg.lstsq((cloud - cloud.mean(0)).expand(6, -1, -1), offered.obj).solution
        points = offered.points @ axes.mT[:, None] + cloud.mean(0)
        judged = thin
        if finalists > 1:
            judged, points = problem.hand, posed_cloud(thin, points, problem.hand)
        scores = choice_scores(judged, problem.field, points, config.choice.penalties).reshape(2, 6)
        chosen += scores.argmax(1).tolist()
        for row, best in enumerate(scores.argmax(1).tolist()):
            torch.testing.assert_close(decoded.points[row, 0], offered.points[3 * row + best // 2, best % 2])
            torch.testing.assert_close(decoded.z[row, 0], offered.z[3 * row + best // 2, best % 2])
    assert len(set(chosen)) > 1
    network.offered.clear()
    with torch.no_grad():
        propose(problem, network, 4, torch.Generator().manual_seed(0), replace(config, choice=ChoiceConfig.first()))
    assert [moves.points.shape[:2] for moves in network.offered] == [(2, 1)] * 2


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


@pytest.mark.parametrize("wrong", [{"draws": 0}, {"placements": -1}, {"finalists": 0}])
def test_less_than_one_draw_is_refused(wrong: dict[str, int]) -> None:
    (name, value), = wrong.items()
    with pytest.raises(OptionError, match=f"{name} is {value}; draw at least one"):
        ChoiceConfig(**wrong)


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadowhand"])
def test_links_stand_where_their_thinned_points_are(name: str) -> None:
    whole, generator = loaded_hand(name), torch.Generator().manual_seed(1)
    thin, q = whole.with_points(160), whole.random_joints(6, generator)
    T = torch.eye(4).repeat(6, 1, 1)
    T[:, :3, 3] = torch.randn(6, 3, generator=generator)
    posed = posed_cloud(thin, thin.points(q, T).unflatten(0, (2, 3)), whole)
    true = whole.points(q, T).unflatten(0, (2, 3))
    known = thin.registrable[whole.link_index]
    torch.testing.assert_close(posed[..., known, :], true[..., known, :], atol=1e-4, rtol=0)
    moved, of_other = thin.points(q, T), (thin.link_index != whole.link_index[~known][:, None]) * 1e3
    apart = torch.cdist(posed[..., ~known, :].flatten(0, 1), moved) + of_other
    assert float(apart.amin(-1).amax() if apart.numel() else 0.0) < 1e-3, "a point of their own link"
