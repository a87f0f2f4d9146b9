"""GenDexGrasp as a method: what its grasps are of, that a seed repeats them, and that they move with the object."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from dro_grasp.errors import WeightsError
from dro_grasp.network.checkpoints import save_weights
from dro_grasp.objects.loading import object_in_memory
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.training.runs import recalibrate
from lab.methods.gendexgrasp.map_fitting import FittingConfig
from lab.methods.gendexgrasp.map_method import GenDexGrasp
from lab.methods.gendexgrasp.map_network import LATENT, ContactMapNetwork
from tests.helpers.toy_hand import toy_hand

SHIFT = np.array([0.25, -0.125, 0.5])  # exact in binary, so that the object keeps its shape to the last digit


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("maps") / "maps.safetensors"
    torch.manual_seed(0)
    network = ContactMapNetwork()
    # Random weights with statistics of points of this size give maps of light and dark places.
    recalibrate(network, lambda: network.decode(0.02 * torch.randn(16, 64, 3), torch.randn(16, LATENT)), 1)
    save_weights(network, path)
    return path


def box(at: np.ndarray) -> ObjectModel:
    mesh = trimesh.creation.box((0.0625, 0.03125, 0.046875))
    return object_in_memory(mesh.apply_translation(at))


@pytest.fixture(scope="module")
def obj() -> ObjectModel:
    return box(np.zeros(3))


def quick(weights: Path, steps: int = 2, particles: int = 3) -> GenDexGrasp:
    return GenDexGrasp(weights, FittingConfig(particles=particles, steps=steps, hand_points=48))


def test_grasps_are_of_the_hand_on_the_object_and_the_seed_repeats_them(weights: Path, obj: ObjectModel) -> None:
    hand, method = toy_hand(), quick(weights)
    grasps, again, other = (method.propose(GraspProblem(hand, obj), 5, seed) for seed in (3, 3, 4))
    assert (len(grasps), grasps.hand, set(grasps.object), grasps.joint_names) == (5, "toy", {obj.name}, hand.tree.joint_names)
    assert set(grasps.provenance) == {"GenDexGrasp gendexgrasp"}
    assert set(grasps.seed.tolist()) == {3}
    assert not bool(grasps.evaluated.any())
    assert not bool(grasps.score.isfinite().any()), "nothing is ranked"
    assert bool(((grasps.joints >= hand.lower) & (grasps.joints <= hand.upper)).all())
    rotation = grasps.T_object_wrist[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand(5, 3, 3), atol=1e-5, rtol=0)
    assert torch.equal(grasps.T_object_wrist, again.T_object_wrist)
    assert torch.equal(grasps.joints, again.joints)
    assert float((grasps.joints - other.joints).abs().max()) > 0.05
    assert float(torch.pdist(grasps.joints).min()) > 1e-3, "one map, and one grasp, each"


def test_an_object_elsewhere_has_the_same_grasps_there(weights: Path, obj: ObjectModel) -> None:
    """The network sees objects about their centres: no grasp depends on where an object's frame is."""
    hand, method = toy_hand(), quick(weights)
    here, there = method.propose(GraspProblem(hand, obj), 2, 0), method.propose(GraspProblem(hand, box(SHIFT)), 2, 0)
    torch.testing.assert_close(there.energy, here.energy, atol=1e-4, rtol=1e-3)
    torch.testing.assert_close(there.joints, here.joints, atol=2e-3, rtol=0)
    moved = here.T_object_wrist[:, :3, 3] + torch.from_numpy(SHIFT).float()
    torch.testing.assert_close(there.T_object_wrist[:, :3, 3], moved, atol=2e-3, rtol=0)


def test_descents_lower_the_energy_that_is_told(weights: Path, obj: ObjectModel) -> None:
    start, end = (quick(weights, steps, 1).propose(GraspProblem(toy_hand(), obj), 2, 0).energy for steps in (0, 12))
    assert bool((end < 0.95 * start).all())


def test_missing_and_foreign_weights_are_refused(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match=r"none\.safetensors"):
        GenDexGrasp(tmp_path / "none.safetensors")
    save_weights(torch.nn.Linear(2, 2), tmp_path / "other.safetensors")
    with pytest.raises(WeightsError, match="use weights made with this version"):
        GenDexGrasp(tmp_path / "other.safetensors")
