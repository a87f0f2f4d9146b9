"""Several objects of one hand at once: what each would get alone, together on a device, one by one on a CPU."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from dro_grasp.errors import NoGraspError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.fingers import ClosingConfig
from dro_grasp.optimize.grasp_energy import GraspEnergy
from dro_grasp.optimize.refinement import RefineConfig
from dro_grasp.optimize.squeeze import GripConfig
from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize
from dro_grasp.predict.config import GraspRequest, PredictorConfig, RescueConfig
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.finish import FinishConfig
from dro_grasp.predict.predictor import GraspPredictor, Prediction
from dro_grasp.predict.problem import GraspProblem, problems_of
from dro_grasp.predict.score.score import ScoreConfig
from dro_grasp.predict.sources.network import ProposalConfig
from dro_grasp.predict.sources.optimiser import OptimiserConfig
from dro_grasp.predict.stages import grouped
from tests.helpers.toy_hand import toy_hand

HAND = toy_hand()
OBJECTS = [load_object(name) for name in ("sphere", "cube", "can")]
AT_ONCE = 512
ROUGH = {"atol": 1e-4, "rtol": 1e-3}


def config(together: bool) -> PredictorConfig:
    """A quick pipeline: in parts for a CPU's cache, or as on a device, everything in one batch."""
    size = AT_ONCE if together else None
    refine = RefineConfig(
        steps=10, batch_size=size, closing=ClosingConfig(batch_size=size), grip=GripConfig(batch_size=size))
    return PredictorConfig(
        ProposalConfig(batch_size=size, network_batch_size=size),
        OptimiserConfig(synthesis=SynthesisConfig(steps=10, batch_size=8, at_once=size)),
        finish=FinishConfig(refine=refine, score=ScoreConfig(batch_size=size)), rescue=RescueConfig(per_grasp=2),
        together=together)


def close(found: GraspBatch, expected: GraspBatch) -> None:
    assert len(found) == len(expected)
    assert found.object == expected.object
    for name in ("T_object_wrist", "joints", "pregrasp_joints", "squeeze_joints", "score"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), **ROUGH)


@pytest.mark.parametrize("source", ["network", "optimiser", "auto"])
def test_each_object_gets_what_it_gets_alone(weights: str, source: str) -> None:
    alone = [GraspPredictor(weights, config=config(False)).predict(HAND, obj, 3, seed=4, source=source) for obj in OBJECTS]
    one_by_one = GraspPredictor(weights, config=config(False)).predict_many(HAND, OBJECTS, 3, seed=4, source=source)
    together = GraspPredictor(weights, config=config(True)).predict_many(HAND, OBJECTS, 3, seed=4, source=source)
    for own, first, second in zip(alone, one_by_one, together, strict=True):
        assert torch.equal(first.joints, own.joints)
        assert torch.equal(first.score, own.score)
        close(second, own)


def test_objects_with_surroundings_are_computed_alone() -> None:
    free, bound = (problems_of(HAND, OBJECTS[:2], "cpu", given) for given in (Constraints(), Constraints(table=-0.05)))
    assert grouped([*free, bound[0]], [4, 4, 4], given=8) == [[0, 1], [2]]
    assert grouped(free, [4, 0], given=8) == [[0]]
    assert grouped(free, [4, 4]) == [[0], [1]]


def test_an_object_without_grasps_has_an_empty_batch(weights: str) -> None:
    doubtful = GraspPredictor(weights, config=config(True))
    with pytest.warns(UserWarning, match="meet what was asked of them"):
        found = doubtful.predict_many(HAND, OBJECTS[:2], 2, source="network", least_confidence=0.999999)
    assert [len(grasps) for grasps in found] == [0, 0]
    assert GraspBatch.concatenate(found).asked == 4, "what is not returned has failed"
    made = doubtful.run_many(
        problems_of(HAND, OBJECTS[:1], "cpu", Constraints()), GraspRequest(2, source="network", least_confidence=0.999999))
    assert isinstance(made[0], NoGraspError)
    assert doubtful.predict_many(HAND, [], 2) == []


def test_the_time_of_all_is_shared(weights: str) -> None:
    made = GraspPredictor(weights, config=config(True)).run_many(
        problems_of(HAND, OBJECTS, "cpu", Constraints()), GraspRequest(2, source="network"))
    network = {one.seconds["network"] for one in made if isinstance(one, Prediction)}
    assert len(network) == 1
    assert min(network) > 0


@pytest.mark.parametrize("index", [slice(0, 2), slice(3, 7)])
def test_a_joined_energy_has_the_values_of_each(index: slice) -> None:
    energies = [GraspProblem(HAND, obj).energy(RefineConfig().energy) for obj in OBJECTS]
    batches = [synthesize(HAND, obj, 3, 0, SynthesisConfig(steps=2)) for obj in OBJECTS]
    T, q = (torch.cat([getattr(batch, name) for batch in batches]) for name in ("T_object_wrist", "joints"))
    expected = [energy(batch.T_object_wrist, batch.joints) for energy, batch in zip(energies, batches, strict=True)]
    joined = GraspEnergy.joined(energies, [3, 3, 3])
    for found, rows in ((joined(T, q), slice(None)), (joined.rows(index)(T[index], q[index]), index)):
        for name in ("terms", "by_pose", "by_joint"):
            whole = torch.cat([getattr(own, name) for own in expected])[rows]
            torch.testing.assert_close(getattr(found, name), whole, atol=1e-4, rtol=1e-5)


def test_energies_that_differ_are_not_joined() -> None:
    plain, table = (GraspProblem(HAND, OBJECTS[0], constraints=given).energy(RefineConfig().energy)
                    for given in (Constraints(), Constraints(table=-0.05)))
    other = GraspProblem(HAND, OBJECTS[1]).energy(replace(RefineConfig().energy, penetration=1.0))
    for wrong in (table, other):
        with pytest.raises(ValueError, match="cannot be joined"):
            GraspEnergy.joined([plain, wrong], [1, 1])


def test_a_second_object_shares_what_is_prepared_of_the_hand() -> None:
    first, second = problems_of(HAND, OBJECTS[:2], "cpu", Constraints())
    alone = GraspProblem(HAND, OBJECTS[1])
    grasps = synthesize(HAND, OBJECTS[1], 3, 0, SynthesisConfig(steps=2))
    energies = [problem.energy(RefineConfig().energy) for problem in (second, alone)]
    found, expected = (energy(grasps.T_object_wrist, grasps.joints).terms for energy in energies)
    assert torch.equal(found, expected)
    assert second.thinned(8) is first.thinned(8)
    assert second.centre.tolist() == alone.centre.tolist() != first.centre.tolist()
