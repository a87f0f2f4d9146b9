"""What a grasp shall carry: mass, margin and largest force reach squeeze and ranking; bad values are refused by name."""

from __future__ import annotations

import dataclasses
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import dro_grasp as dro
from dro_grasp.errors import DroGraspError, NoGraspError, OptionError
from dro_grasp.objects.shape import DENSITY, solid_of, with_mass
from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize
from dro_grasp.predict import finish
from dro_grasp.predict.config import GraspRequest, PredictorConfig, RescueConfig
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.settling import HARSH, SettleConfig, weigh_settled_all, weight_config
from dro_grasp.predict.stages import refine, scored
from dro_grasp.simulation.forces import find_forces
from dro_grasp.simulation.grasp_state import WeightConfig
from dro_grasp.simulation.protocols import PROTOCOLS
from dro_grasp.simulation.scene import object_mass
from dro_grasp.simulation.weighing import WeighingConfig
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.one_object import settle_best, settle_grasps
from tests.helpers.weights import untrained_weights

HAND, CAN = loaded_hand("gripper3"), dro.load_object("can")
HELD = SettleConfig(weight=WeightConfig(pull=0.0))


@pytest.fixture(scope="module")
def grasps() -> dro.GraspBatch:
    return refine(GraspProblem(HAND, CAN), synthesize(HAND, CAN, 12, 1, SynthesisConfig(batch_size=12, steps=20)))


def test_a_mass_replaces_density_and_volume() -> None:
    heavy, cloud = dro.load_object("can", mass=0.7), dro.load_object(CAN.cloud, keep_table=True)
    assert heavy.mass == pytest.approx(0.7)
    assert heavy.volume == CAN.volume
    assert object_mass(heavy, PROTOCOLS["carry"]) == pytest.approx(0.7)
    assert heavy.solid_sha256 != CAN.solid_sha256, "trials of the two are others"
    assert heavy.sha256 == CAN.sha256
    known = with_mass(cloud, 0.7)
    assert solid_of(known).mass == GraspProblem(HAND, known).mass == pytest.approx(0.7)
    np.testing.assert_array_equal(known.cloud, cloud.cloud)
    assert solid_of(cloud).density == DENSITY


@pytest.mark.parametrize(("call", "told"), [
    (lambda: dro.load_object("can", mass=0.0), r"mass is 0.0; give kilograms, above 0"),
    (lambda: dro.load_object("can", mass=-1.0), "mass is -1.0"),
    (lambda: dro.load_object("can", mass=math.nan), "mass is nan"),
    (lambda: dro.load_object("can", mass=400.0), "400 g are 0.4 kg"),
    (lambda: dro.load_object("can", mass="0.4"), "mass is '0.4'; give a number"),
    (lambda: Constraints(margin=-0.5), "margin is -0.5; give a multiple"),
    (lambda: Constraints(margin=11.0), "margin is 11.0"),
    (lambda: Constraints(margin=math.nan), "margin is nan"),
    (lambda: Constraints(max_force=0.0), "max_force is 0.0; give newtons above 0"),
    (lambda: Constraints(max_force=math.inf), "max_force is inf; .* leave it out"),
    (lambda: Constraints(max_force=True), "max_force is True"),
])
def test_bad_values_are_refused(call: object, told: str) -> None:
    with pytest.raises(DroGraspError, match=told):
        call()  # type: ignore[operator]


def test_what_is_asked_replaces_what_is_configured() -> None:
    asked = GraspProblem(HAND, CAN, constraints=Constraints(margin=2.0, max_force=5.0))
    found = weight_config(asked, SettleConfig())
    assert (found.margin, found.max_force) == (2.0, 5.0)
    usual = weight_config(GraspProblem(HAND, CAN), SettleConfig())
    assert (usual.margin, usual.max_force) == (1.5, math.inf)


def test_settled_grasps_state_payload_and_forces(grasps: dro.GraspBatch) -> None:
    found, stable, *_ = settle_grasps(GraspProblem(HAND, CAN), grasps, HELD)
    assert stable.any()
    for name in ("payload", "squeeze_force", "squeeze_torque"):
        known = getattr(found, name).reshape(len(found), -1).isfinite().all(1)
        assert torch.equal(known, stable), name
    assert float(found.payload[stable].max()) > CAN.mass
    read = find_forces(HAND, CAN, found[stable])
    ratio = read.squeeze_force / found.squeeze_force[stable]
    assert 0.95 < float(ratio.nanmedian()) < 1.05, "closing once more presses as hard"


def test_a_heavier_object_is_squeezed_harder_and_a_fragile_one_gently(grasps: dro.GraspBatch) -> None:
    problems = [GraspProblem(HAND, obj, constraints=asked) for obj, asked in (
        (CAN, Constraints()), (with_mass(CAN, 1.0), Constraints()), (CAN, Constraints(max_force=2.0)))]
    found = [settle_grasps(problem, grasps, HELD) for problem in problems]
    usual, heavy, gentle = ([made.grasps.squeeze_force[made.stable].median() for made in found])
    assert float(gentle) < float(usual) < float(heavy)
    hardest = [c.hardest_link for c in find_forces(HAND, CAN, found[2].grasps[found[2].stable]).squeeze_contacts]
    assert np.quantile(hardest, 0.9) < 2.0
    assert max(hardest) < 1.1 * 2.0, "closing once more presses about as hard"


def test_what_presses_too_hard_however_gently_the_hand_closes_is_not_returned(
    grasps: dro.GraspBatch, tmp_path: Path
) -> None:
    problem = GraspProblem(HAND, CAN, constraints=Constraints(max_force=0.02))
    settled = settle_grasps(problem, grasps)
    assert settled.against[HARSH].any()
    assert not (settled.stable & settled.against[HARSH]).any()
    doubting = PredictorConfig(finish=finish.FinishConfig(least_confidence=0.2), rescue=RescueConfig(trusted_scores=(1.5,)))
    predictor, request = dro.GraspPredictor(untrained_weights(tmp_path), config=doubting), GraspRequest(
        4, candidates=2, source="optimiser")
    with pytest.raises(NoGraspError, match=r"press it harder than max_force.*allow more max_force \(now 0.02 N\)"):
        predictor.run(problem, request)


def test_what_cannot_carry_the_mass_scores_less(grasps: dro.GraspBatch) -> None:
    light, heavy = (settle_best(problem, scored(problem, grasps), 12).grasps.confidence for problem in (
        GraspProblem(HAND, CAN), GraspProblem(HAND, with_mass(CAN, 8.0))))
    assert float(light.max()) > 0.9
    assert float(heavy.max()) < 0.2, "8 kg are too much for three fingers of 1 Nm"


def test_what_held_the_mass_as_it_settled_carries_it_at_least(grasps: dro.GraspBatch) -> None:
    for obj in (CAN, with_mass(CAN, 1.5)):
        problem = GraspProblem(HAND, obj)
        found, stable, known, _ = settle_grasps(problem, grasps)
        settled, rules, gave = found[stable], PROTOCOLS["carry"], known.state.gave[stable]
        held = (gave[:, 0] < rules.max_displacement) & (gave[:, 1] < rules.max_rotation)
        assert torch.equal(settled.payload >= obj.mass, held)
        payload = weigh_settled_all([problem], [settled], WeighingConfig(), SettleConfig())[0]
        assert torch.equal(payload >= obj.mass, held)
        assert not torch.equal(payload, settled.payload)


def test_the_time_for_weighing_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With weighing that takes a quarter of a second more, and easing that takes half of that more."""
    weigh, ease, slept = finish.weigh_settled_all, finish.ease, []

    def slow_weigh(*given: Any) -> Any:
        slept.append("weigh")
        time.sleep(0.25)
        return weigh(*given)

    def slow_ease(*given: Any) -> Any:
        slept.append("ease")
        time.sleep(0.125)
        return ease(*given)

    predictor, problem = dro.GraspPredictor(str(untrained_weights(tmp_path))), GraspProblem(HAND, CAN)
    request = dro.GraspRequest(num=4, candidates=1, source="network")
    predictor.run(problem, request)
    monkeypatch.setattr(finish, "weigh_settled_all", slow_weigh)
    monkeypatch.setattr(finish, "ease", slow_ease)
    begin = time.perf_counter()
    made = predictor.run(problem, request)
    whole = time.perf_counter() - begin
    assert slept == ["weigh", "ease"]
    assert made.seconds["weigh"] > 0.25
    assert 0.125 < made.seconds["ease"] < made.seconds["weigh"]
    assert 0.8 * whole < sum(made.seconds.values()) <= whole


@pytest.mark.parametrize("call", ["run", "run_many", "rounds"])
@pytest.mark.parametrize(("hand", "refined", "settle", "why"), [
    (HAND, False, SettleConfig(), "with refine=False none does"),
    (dataclasses.replace(HAND, description=None), True, SettleConfig(), "no description"),
    (HAND, True, None, "this configuration leaves it out")])
def test_limits_of_forces_are_refused_where_nothing_settles(
    call: str, hand: dro.Hand, refined: bool, settle: SettleConfig | None, why: str, tmp_path: Path
) -> None:
    config = PredictorConfig(finish=finish.FinishConfig(settle=settle))
    predictor, request = dro.GraspPredictor(untrained_weights(tmp_path), config=config), GraspRequest(1, refine=refined)
    problem = GraspProblem(hand, CAN, constraints=Constraints(max_force=2.0, margin=2.0))
    calls = {"run": lambda: predictor.run(problem, request), "run_many": lambda: predictor.run_many([problem], request),
             "rounds": lambda: next(predictor.rounds(problem, request))}
    with pytest.raises(OptionError, match=f"margin and max_force say how hands squeeze once they settle, and .*{why}"):
        calls[call]()
