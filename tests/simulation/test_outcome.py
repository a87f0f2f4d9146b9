"""Why grasps fail, and what is said to do next."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from dro_grasp.apps.report import told_of
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import CONTACT_LINKS, REASON
from dro_grasp.simulation.contacts import Penetration
from dro_grasp.simulation.outcome import REMEDIES, Failure, Measurements, count_failures, diagnose, next_steps
from dro_grasp.simulation.protocols import Protocol
from tests.helpers.toy_hand import toy_hand


def grasps(*failures: Failure | None, evaluated: bool = True) -> GraspBatch:
    hand, n = toy_hand(), len(failures)
    from tests.helpers.claw import ball

    made = GraspBatch.create(hand, ball(), torch.eye(4).expand(n, 4, 4), torch.zeros(n, hand.tree.n_dof))
    if not evaluated:
        return made
    names = [failure.name if failure else None for failure in failures]
    held = torch.tensor([failure is None for failure in failures])
    return made.replace(success=held, protocol=("strict/1",) * n, extra={"failure": names})


def test_failures_are_counted_in_words_the_most_frequent_first() -> None:
    batch = grasps(None, Failure.SLIPPED, Failure.PENETRATION, Failure.SLIPPED, None, None)
    assert list(count_failures(batch).items()) == [("slipped", 2), ("hand penetrates object", 1)]
    assert diagnose(batch) == ["  2 failed: slipped", "  1 failed: hand penetrates object"]


@pytest.mark.parametrize("kind", ["displacement", "rotation"])
def test_with_a_reset_every_force_counts_and_without_one_the_last_alone(kind: str) -> None:
    """Six trials; in each, another force moves or turns the object farther than the limit."""
    still, zero = np.full((6, 6), 1e-3), np.zeros(6)
    values = {"displacement": still, "rotation": still} | {kind: still + 0.049 * np.eye(6)}
    touching, fingers = (("tip",),) * 6, torch.ones(6, dtype=torch.int64)
    found = Measurements(Penetration(zero, zero), zero, zero, touching, fingers, stable=zero == 0, **values)
    rules = Protocol("own", max_displacement=0.02, max_rotation=0.02)
    assert found.judged(rules).success.tolist() == [True] * 5 + [False]
    anew = found.judged(dataclasses.replace(rules, reset=True))
    assert not anew.success.any()
    assert set(anew.failure) == {Failure.SLIPPED if kind == "displacement" else Failure.TURNED}


def test_where_few_hold_the_next_step_is_named() -> None:
    batch = grasps(None, Failure.NO_CONTACT, Failure.NO_CONTACT, Failure.UNSTABLE)
    assert next_steps(batch) == [REMEDIES[Failure.NO_CONTACT], REMEDIES[Failure.UNSTABLE]]
    assert diagnose(batch)[-2:] == [f"  next: {step}" for step in next_steps(batch)]
    same = grasps(Failure.SLIPPED, Failure.LOST)
    assert len(next_steps(same)) == 1, "no advice is given twice"


@pytest.mark.parametrize(("origin", "advised"), [(["optimiser"] * 2, False), (["network", "optimiser"], True)])
def test_the_optimiser_is_not_advised_where_it_made_all(origin: list[str], advised: bool) -> None:
    from tests.helpers.claw import ball

    batch, made = grasps(Failure.SLIPPED, Failure.LOST), SimpleNamespace(shortage=None, candidates=2, dropped={}, origin=origin)
    batch = batch.replace(extra={**batch.extra, REASON: ["slipped"] * 2, CONTACT_LINKS: [[]] * 2})
    told = told_of(ball(), cast(Any, made), batch, hand="toy", num=2, seed=0, weights="w", protocol="strict", frame="object")
    assert "candidates=16" in "".join(told.report["next"])
    assert ("optimiser" in "".join(told.report["next"]), "optimiser" in "".join(told.lines)) == (advised, advised)


@pytest.mark.parametrize("batch", [grasps(None, None, Failure.SLIPPED), grasps(None, None), grasps(None, evaluated=False)])
def test_nothing_is_advised_where_most_hold_or_nothing_was_evaluated(batch: GraspBatch) -> None:
    assert next_steps(batch) == []


def test_every_failure_has_a_remedy() -> None:
    assert set(REMEDIES) == set(Failure)


def test_kinds_of_failure_of_a_later_version_are_left_out() -> None:
    batch = grasps(None, Failure.SLIPPED)
    assert count_failures(batch.replace(extra={"failure": [None, "MELTED"]})) == {}
