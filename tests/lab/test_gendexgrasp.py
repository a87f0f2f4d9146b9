"""GenDexGrasp: maps against loops over points, the network against its plain form, fits against a known grasp."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from pathlib import Path

import pytest
import torch

from dro_grasp.compare.methods import make_method
from dro_grasp.errors import WeightsError
from dro_grasp.network.checkpoints import save_weights
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.training.config import ScheduleConfig
from lab.methods import train
from lab.methods.bundle_draws import BundleDraws
from lab.methods.gendexgrasp import contact_maps, map_method
from lab.methods.gendexgrasp.contact_maps import contact_map, sharpened
from lab.methods.gendexgrasp.map_fitting import FittingConfig, MapTarget, fit, map_energy
from lab.methods.gendexgrasp.map_network import LATENT, ContactMapNetwork
from lab.methods.gendexgrasp.map_training import MapTrainingConfig, draw_maps, map_losses, train_contact_maps
from tests.helpers.toy_hand import toy_hand

SMALL = MapTrainingConfig(ScheduleConfig(steps=6, recalibration=2, log_every=1), batch=4, points=32, hand_points=24)


def cloud(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Points of a sphere of 4 cm off the origin, and their normals."""
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(seed)), dim=-1)
    return 0.04 * normals + 0.3, normals


@pytest.mark.parametrize("gamma", [0.0, 1.0, 2.0])
def test_a_map_is_what_loops_say(gamma: float) -> None:
    points, normals = cloud(12)
    hand = 0.3 + 0.05 * torch.randn(2, 9, 3, generator=torch.Generator().manual_seed(1))
    found = contact_map(points, normals, hand, gamma)
    for b in range(2):
        for i in range(12):
            apart = []
            for h in hand[b]:
                offset = [float(x) for x in h - points[i]]
                d = math.sqrt(sum(x * x for x in offset))
                cosine = sum(x * float(n) for x, n in zip(offset, normals[i], strict=True)) / d
                apart.append(d * math.exp(gamma * (1 - cosine)))
            x = 10 * math.sqrt(min(apart))
            assert float(found[b, i]) == pytest.approx(1 - 2 * (1 / (1 + math.exp(-x)) - 0.5), abs=2e-4)


def test_hands_in_parts_have_the_map_of_all_hands_together(monkeypatch: pytest.MonkeyPatch) -> None:
    points, normals = cloud(12)
    hands = 0.3 + 0.05 * torch.randn(5, 9, 3, generator=torch.Generator().manual_seed(1))
    together = contact_map(points, normals, hands, 2.0)
    monkeypatch.setattr(contact_maps, "CACHED_PAIRS", 2 * 12 * 9)
    assert torch.equal(contact_map(points, normals, hands, 2.0), together)
    assert torch.equal(contact_map(points, normals, hands[3], 2.0), together[3])


def test_a_hand_beside_a_point_counts_as_farther_than_one_above_it() -> None:
    point, normal = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]])
    above, beside, touching = (torch.tensor([[x]]) for x in ([0.0, 0, 0.01], [0.01, 0, 0], [0.0, 0, 0]))
    values = [float(contact_map(point, normal, hand, 1.0)) for hand in (above, beside, touching)]
    assert values[0] == pytest.approx(2 - 2 / (1 + math.exp(-1.0)), abs=1e-3)
    assert values[1] == pytest.approx(2 - 2 / (1 + math.exp(-math.exp(0.5))), abs=1e-3)
    assert values[2] == pytest.approx(1, abs=1e-2)


def test_gradients_are_those_of_finite_differences() -> None:
    points, normals = (x.double() for x in cloud(8))
    hand = (0.3 + 0.05 * torch.randn(3, 3, generator=torch.Generator().manual_seed(3))).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: contact_map(points, normals, x, 2.0), hand, eps=1e-7, atol=1e-4)


def test_sharpening_raises_what_is_touched() -> None:
    contact = torch.tensor([[0.1, 0.41, 0.7], [0.1, 0.39, 0.45]])
    expected = torch.tensor([[0.1, 0.91, 1.0], [0.1, 0.39, 1.0]])
    assert torch.allclose(sharpened(contact), expected)


def test_the_heads_first_layer_sees_everything_at_once() -> None:
    """Split by inputs for speed, it is one linear layer over local feature, global feature and z."""
    network = ContactMapNetwork().eval()
    points, z = 0.05 * torch.randn(2, 8, 3), torch.randn(2, LATENT)
    local = network.local(points.flatten(0, 1)).unflatten(0, (2, 8))
    whole = network.whole(local.flatten(0, 1)).unflatten(0, (2, 8)).amax(1)
    joined = torch.cat([local, torch.cat([whole, z], -1)[:, None].expand(-1, 8, -1)], -1)
    weight = torch.cat([network.head_local.weight, network.head_shared.weight], 1)
    assert weight.shape == (512, 704)
    hidden = torch.nn.functional.linear(joined, weight, network.head_local.bias)
    assert torch.allclose(network.head(hidden.flatten(0, 1)).view(2, 8), network.decode(points, z), atol=1e-5)


def test_training_lowers_the_error_and_resumes(bundle, tmp_path: Path) -> None:
    points, true = draw_maps(BundleDraws(bundle, SMALL.hand_points), SMALL, torch.Generator().manual_seed(0))
    assert true.shape == (4, 32)
    assert float(points.mean(1).norm(dim=-1).max()) < 0.02, "about the object's centre"
    torch.manual_seed(0)
    network, noise = ContactMapNetwork(), torch.randn(4, LATENT)
    optimiser = torch.optim.Adam(network.parameters(), 3e-3)
    errors = []
    for _ in range(15):
        optimiser.zero_grad()
        losses = map_losses((true, network(points, true, noise)), SMALL, 0.0)
        losses["total"].backward()
        optimiser.step()
        errors.append(float(losses["error"].detach()))
    assert errors[-1] < 0.8 * errors[0]
    half = dataclasses.replace(SMALL, schedule=dataclasses.replace(SMALL.schedule, minutes=1e-9))
    train_contact_maps(bundle, half, tmp_path / "run")
    resumed = train_contact_maps(bundle, SMALL, tmp_path / "run")
    whole = train_contact_maps(bundle, SMALL, tmp_path / "whole")
    steps = [json.loads(line)["step"] for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert steps == [1, 2, 3, 4, 5, 6]
    assert not resumed.training
    assert resumed.state_dict().keys() == whole.state_dict().keys()


def test_divergence_weighs_more_in_the_end() -> None:
    network, points = ContactMapNetwork(), 0.05 * torch.randn(4, 8, 3)
    output = network(points, torch.rand(4, 8), torch.randn(4, LATENT))
    true = torch.rand(4, 8)
    losses = [map_losses((true, output), SMALL, share) for share in (0.0, 1.0)]
    weights = [float(((each["total"] - 1000 * each["error"]) / each["nats"]).detach()) for each in losses]
    assert weights == pytest.approx([0.05, 0.05 * 1.5**9], rel=1e-2)


def test_a_hand_finds_back_to_the_map_of_a_known_grasp() -> None:
    hand, obj = toy_hand(), load_object("sphere")
    rows = torch.randperm(len(obj.cloud), generator=torch.Generator().manual_seed(0))[:96]
    points, normals = torch.from_numpy(obj.cloud)[rows], torch.from_numpy(obj.cloud_normals)[rows]
    q = hand.canonical_joints(0.5)[None]
    T = torch.eye(4)[None].clone()
    T[0, :3, 3] = points.mean(0) - hand.grasp_centre_wrist - 0.03 * hand.palm_direction_wrist
    goal = contact_map(points, normals, hand.points(q, T), 2.0)
    target, config = MapTarget(points, normals, goal, obj.distance_field), FittingConfig(particles=8, steps=60)
    far = T.clone()
    far[0, :3, 3] += 0.05
    known, away = (float(map_energy(hand, target, goal, pose, q, FittingConfig(penetration=0.0))) for pose in (T, far))
    assert known < 0.01 < away
    found, joints, energy = fit(hand, target, config, torch.Generator().manual_seed(1))
    begun = fit(hand, target, dataclasses.replace(config, steps=0), torch.Generator().manual_seed(1))[2]
    assert found.shape == (1, 4, 4)
    assert bool(((joints >= hand.lower) & (joints <= hand.upper)).all())
    assert float(energy) < 0.7 * float(begun)
    rotation = found[0, :3, :3]
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3), atol=1e-4)


def test_training_makes_a_method_that_the_benchmark_takes(bundle, home: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(map_method, "FittingConfig", lambda **_: FittingConfig(particles=2, steps=2))
    monkeypatch.setattr(train, "MapTrainingConfig", functools.partial(MapTrainingConfig, batch=4, points=16))
    weights = tmp_path / "maps.safetensors"
    train.train("gendexgrasp", home / "bundle.safetensors", tmp_path / "run", weights, steps=1)
    assert weights.stat().st_size < 3_000_000
    named = make_method("lab.methods.gendexgrasp:GenDexGrasp")
    assert named.name == "gendexgrasp"
    assert len(named.propose(GraspProblem(toy_hand(), load_object("sphere")), 1, 3)) == 1
    method = map_method.GenDexGrasp(weights)
    grasps = method.propose(GraspProblem(toy_hand(), load_object("sphere")), 2, 3)
    assert len(grasps) == 2
    assert bool(grasps.energy.isfinite().all())
    assert torch.equal(grasps.joints, method.propose(GraspProblem(toy_hand(), load_object("sphere")), 2, 3).joints)


def test_foreign_weights_are_refused(tmp_path: Path) -> None:
    save_weights(torch.nn.Linear(2, 2), tmp_path / "other.safetensors")
    with pytest.raises(WeightsError, match="use weights made with this version"):
        map_method.GenDexGrasp(tmp_path / "other.safetensors")
