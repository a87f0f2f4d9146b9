from __future__ import annotations

import math
from dataclasses import replace

import pytest

from dro_grasp.errors import OptionError
from dro_grasp.grasps.controller import ControllerConfig
from dro_grasp.simulation.protocols import PROTOCOLS, protocol


def test_the_paper_s_protocol():
    rules = protocol("dro")
    assert (rules.friction, rules.force, rules.max_displacement) == (1.0, 0.5, 0.02)
    assert (rules.closing_time, rules.force_time, rules.closing) == (1.0, 1.0, True)
    assert rules.max_penetration == rules.max_closing_shift == math.inf


def test_strict_is_dro_and_more():
    strict, dro = protocol("strict"), protocol("dro")
    assert (strict.max_penetration, strict.max_self_penetration, strict.max_closing_shift) == (0.005, 0.005, 0.02)
    assert math.degrees(strict.max_closing_rotation) == pytest.approx(30)
    limits = ("max_penetration", "max_self_penetration", "max_closing_shift", "max_closing_rotation")
    assert replace(strict, name="dro", **dict.fromkeys(limits, math.inf)) == dro


def test_static_only_does_not_close():
    assert replace(protocol("dro_static"), name="dro", closing=True) == protocol("dro")


def test_label_tells_variants_apart():
    dro = protocol("dro")
    assert dro.label == "dro/1"
    assert replace(dro, friction=3.0).label == "dro+friction3/1"
    assert replace(dro, controller=ControllerConfig(inner=0.2)).label == "dro+changed/1"
    assert len({p.label for p in PROTOCOLS.values()}) == len(PROTOCOLS)


def test_a_protocol_of_ones_own_passes_through():
    mine = replace(protocol("dro"), name="mine", force=1.0)
    assert protocol(mine) is mine
    assert mine.label == "mine/1"


def test_unknown_name_lists_the_choices():
    with pytest.raises(OptionError, match=r"'hard'.*dro, strict, robust, dro_static"):
        protocol("hard")


def test_robust_is_strict_under_perturbations():
    strict, robust = protocol("strict"), protocol("robust")
    assert replace(robust, name="strict", perturbations=strict.perturbations) == strict
    assert strict.perturbations.trials == 1
    assert robust.label == "robust/1"
    fewer = replace(robust, perturbations=replace(robust.perturbations, trials=7))
    assert fewer.label == "robust+changed/1"
