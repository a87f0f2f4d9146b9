"""ManiFM-style: labels of analytic contacts, suppression by hand, and assignments that find a known posture."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import pytest
import torch

from dro_grasp.compare.methods import make_method
from dro_grasp.geometry.se3 import apply
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.problem import GraspProblem
from lab.methods import train
from lab.methods.bundle_draws import BundleDraws
from lab.methods.manifm.contact_method import ContactMethod, ContactMethodConfig, reached
from lab.methods.manifm.contact_network import LATENT, ContactNetwork
from lab.methods.manifm.contact_training import ContactTrainingConfig, contact_losses, draw_contacts, open_hand_cloud
from lab.methods.manifm.fingertip_contacts import REACH, WIDTH, Pads, contact_maps, contacts_of
from tests.helpers.toy_hand import toy_hand

HAND = toy_hand()
SMALL = ContactTrainingConfig(batch=4, points=24, hand_points=48)


def ball(count: int = 400) -> tuple[torch.Tensor, torch.Tensor]:
    """A sphere of 3 cm: points and normals."""
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    return 0.03 * normals, normals


def test_fingers_leave_heat_and_balanced_forces_where_they_touch() -> None:
    points, normals = ball()
    owner = HAND.finger_of_link[HAND.link_index]
    directions = torch.nn.functional.normalize(torch.tensor([[1.0, 0, 0], [-0.5, 0.87, 0], [-0.5, -0.87, 0]]), dim=-1)
    body = torch.full((1, HAND.n_points, 3), 1.0)
    for finger, direction in enumerate(directions):
        body[0, owner == finger] = (0.03 + 0.5 * REACH) * direction
    maps = contact_maps(points[None], normals[None], HAND, body)
    touched = points[torch.cdist(directions * 0.03, points).argmin(1)]
    expected = (-torch.cdist(touched, points).square() / (2 * WIDTH**2)).exp().amax(0)
    assert torch.allclose(maps.heat[0], expected, atol=1e-4)
    hot = torch.cdist(touched, points).argmin(1)
    forces = maps.force[0, hot]
    assert float(forces.sum(0).norm()) < 0.1 * float(forces.norm(dim=-1).sum()), "three fingers evenly around hold a ball"
    assert bool(((forces * directions).sum(-1) < 0).all()), "forces press on the object"
    away = contact_maps(points[None], normals[None], HAND, body + 0.1)
    assert float(away.heat.max()) == 0
    assert float(away.force.abs().max()) == 0


def test_contacts_are_hot_and_apart() -> None:
    points = torch.tensor([[0.0, 0, 0], [0.01, 0, 0], [0.03, 0, 0], [0.06, 0, 0]])
    heat = torch.tensor([[0.8, 0.9, 0.5, 0.1], [0.9, 0.8, 0.1, 0.5]])
    assert contacts_of(points, heat, 2, 0.015).tolist() == [[1, 2], [0, 3]]


def test_pads_are_inside_the_closing_hand() -> None:
    pads = Pads.of(HAND)
    assert len(pads.links) == len(HAND.fingers)
    poses = HAND.tree.forward(HAND.canonical_joints(0.5))[pads.links]
    points = apply(poses, pads.points)
    inward = HAND.grasp_centre_wrist - points
    normals = (poses[:, :3, :3] @ pads.normals[..., None])[..., 0]
    assert bool(((inward * normals).sum(-1) > 0).all())


def test_a_hand_reaches_the_contacts_of_a_known_posture_in_any_order() -> None:
    problem, pads = GraspProblem(HAND, load_object("sphere")), Pads.of(HAND)
    q = HAND.canonical_joints(0.45)[None]
    T = torch.eye(4)[None].clone()
    T[0, :3, 3] = -HAND.grasp_centre_wrist
    poses = T[:, None] @ HAND.tree.forward(q)[:, pads.links]
    spots = apply(poses, pads.points)
    normals = -(poses[..., :3, :3] @ pads.normals[..., None])[..., 0]
    order = torch.tensor([2, 0, 1])
    config = dataclasses.replace(ContactMethodConfig(), depth=0.0)
    found, joints = reached(problem, pads, spots[:, order], normals[:, order], config)
    placed = apply(found[:, None] @ HAND.tree.forward(joints)[:, pads.links], pads.points)
    assert float(torch.cdist(spots[0], placed[0]).amin(1).max()) < 5e-4


def test_losses_fall(bundle) -> None:
    obj, told, true = draw_contacts(BundleDraws(bundle, SMALL.hand_points), SMALL, torch.Generator().manual_seed(0))
    assert obj.shape == (4, 24, 6)
    assert torch.equal(told[0], open_hand_cloud(HAND.with_points(48)))
    torch.manual_seed(0)
    network, noise = ContactNetwork(), torch.randn(4, LATENT)
    optimiser = torch.optim.Adam(network.parameters(), 3e-3)
    totals = []
    for _ in range(15):
        optimiser.zero_grad()
        losses = contact_losses((true, network(obj, told, true, noise)), SMALL, 0.0)
        losses["total"].backward()
        optimiser.step()
        totals.append(float(losses["total"].detach()))
    assert totals[-1] < 0.5 * totals[0]
    end = contact_losses((true, network(obj, told, true, noise)), SMALL, 1.0)
    rest = float((end["heat"] + 100 * end["force"]).detach())
    nats = float(end["nats"].detach())
    assert float(end["total"].detach()) == pytest.approx(rest + 0.05 * ((1 + nats**2) ** 0.5 - 1), rel=1e-4)


@pytest.mark.slow
def test_training_makes_a_method_that_the_benchmark_takes(
    bundle, home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "ContactTrainingConfig", functools.partial(
        ContactTrainingConfig, batch=4, points=16, hand_points=48))
    weights = tmp_path / "contacts.safetensors"
    train.train("manifm", home / "bundle.safetensors", tmp_path / "run", weights, steps=2)
    assert weights.stat().st_size < 3_000_000
    assert make_method("lab.methods.manifm:ContactMethod").name == "manifm"
    method, problem = ContactMethod(weights), GraspProblem(HAND, load_object("sphere"))
    grasps = method.propose(problem, 2, 3)
    assert len(grasps) == 2
    assert bool(grasps.states_closing.all())
    assert torch.equal(grasps.joints, method.propose(problem, 2, 3).joints)
