from __future__ import annotations

import math
from dataclasses import fields, is_dataclass, replace

import pytest

from dro_grasp.errors import OptionError
from dro_grasp.grasps.controller import ControllerConfig
from dro_grasp.simulation.protocols import PROTOCOLS, Protocol, changed, protocol


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
    assert replace(dro, controller=ControllerConfig(inner=0.2)).label == "dro+controller.inner=0.2/1"
    assert replace(dro, friction=3.0, closing=False, mass=0.1).label == "dro+closing=False+friction3+mass=0.1/1"
    assert len({p.label for p in PROTOCOLS.values()}) == len(PROTOCOLS)


def other_values(value):
    """Two values that a field of this value could have instead."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, value + 2]
    if isinstance(value, float):
        low = value if 0 < value < math.inf else 1.0
        return [low * 0.5, low * (1 + 1e-9)]
    return [0.25, 0.5] if value is None else [(value[0] * 0.5, value[1]), (value[0], value[1] * 2)]


def every_change(rules):
    """The protocol with one or two fields changed, those of what it is made of included."""
    singles = {}
    for one in fields(rules):
        value = getattr(rules, one.name)
        if is_dataclass(value):
            singles[one.name] = [replace(value, **{inner.name: other}) for inner in fields(value)
                                 if inner.name not in {"needed", "coarse"}
                                 for other in other_values(getattr(value, inner.name))]
        elif one.name != "name":
            singles[one.name] = other_values(value)
    for name, values in singles.items():
        yield from (replace(rules, **{name: value}) for value in values)
    yield from (replace(rules, **{a: singles[a][0], b: singles[b][0]}) for a in singles for b in singles if a < b)


def test_no_two_protocols_share_a_label():
    every = [other for rules in PROTOCOLS.values() for other in (rules, *every_change(rules))]
    assert len(every) > 1000
    assert len({rules.label for rules in every}) == len(set(every)) == len(every)


def test_equal_protocols_share_a_label():
    assert changed("strict", mass_factor=2).label == changed("strict", mass_factor=2.0).label == "strict+mass_factor=2/1"


def test_a_protocol_of_ones_own_passes_through():
    mine = replace(protocol("dro"), name="mine", force=1.0)
    assert protocol(mine) is mine
    assert mine.label == "mine+force=1/1"
    assert Protocol("mine").label == "mine/1"


@pytest.mark.parametrize("name", ["dro+friction3", "dro/1", "", "a b"])
def test_a_name_that_reads_as_a_label_is_refused(name):
    with pytest.raises(OptionError, match="letters, digits"):
        Protocol(name)


@pytest.mark.parametrize(("field", "value"), [
    ("friction", -1.0), ("friction", math.nan), ("mass", 0.0), ("mass_factor", -2.0), ("force_time", 0.0), ("timestep", 0.0),
    ("timestep", math.inf), ("force", -0.5), ("noslip", -1), ("max_displacement", math.nan), ("max_penetration", -0.01)])
def test_numbers_that_no_trial_has_are_refused_by_name(field, value):
    with pytest.raises(OptionError, match=f"{field} of protocol 'mine' is {value}; give a number"):
        replace(protocol("carry"), name="mine", **{field: value})


def test_a_gradual_closing_has_time_for_its_steps():
    with pytest.raises(OptionError, match=r"closing_time of protocol 'mine' is 0.05 s, less than 20 time steps of 0.004 s"):
        replace(protocol("dexgraspbench"), name="mine", closing_time=0.05)
    assert replace(protocol("dro"), name="mine", closing_time=0.05, force=0.0, damping=0.0).closing_time == 0.05


def test_unknown_name_lists_the_choices():
    with pytest.raises(OptionError, match=r"'hard'.*dro, strict, robust, dro_static"):
        protocol("hard")


def test_robust_is_strict_under_perturbations():
    strict, robust = protocol("strict"), protocol("robust")
    assert replace(robust, name="strict", perturbations=strict.perturbations) == strict
    assert strict.perturbations.trials == 1
    assert robust.label == "robust/1"
    fewer = replace(robust, perturbations=replace(robust.perturbations, trials=7))
    assert fewer.label == "robust+perturbations.trials=7/1"
