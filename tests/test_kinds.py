"""Numbers as users give them: NumPy's become Python's in every configuration and call, and other things are refused by name."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import math
import pkgutil
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Literal

import numpy as np
import pytest
import torch

import dro_grasp as dro
from dro_grasp.errors import OptionError
from dro_grasp.kinds import Checked, checked, plain
from dro_grasp.network.presets import NetworkConfig

OF_A_GPU = ("dro_grasp.network.fused",) if find_spec("triton") is None else ()  # PyTorch without CUDA comes without Triton


def configurations() -> Iterator[type]:
    """Every configuration in the package, and what else users fill."""
    for module in pkgutil.walk_packages(dro.__path__, "dro_grasp."):
        if not module.name.startswith(("dro_grasp.cli", "dro_grasp.__main__")) and module.name not in OF_A_GPU:
            for name, value in vars(importlib.import_module(module.name)).items():
                named = name.endswith("Config") or name in {"Constraints", "GraspRequest", "Protocol", "Perturbations"}
                if named and inspect.isclass(value) and value.__module__ == module.name and value is not NetworkConfig:
                    yield value


@pytest.mark.parametrize(("given", "kind", "made"), [
    (np.int64(3), int, 3), (torch.tensor(3), int, 3), (np.array(3), int, 3), (np.float32(0.5), float, 0.5), (2, float, 2),
    (torch.tensor(0.5), float, 0.5), (np.int32(2), float, 2.0), (np.True_, bool, True), (None, float | None, None),
    (np.int64(3), int | None, 3), ([1, np.int64(2)], tuple[int, int], (1, 2)),
    (np.arange(3.0), tuple[float, ...], (0.0, 1.0, 2.0)),
    ("b", Literal["a", "b"], "b"), (((1, 2.5),), tuple[tuple[float, float], ...], ((1, 2.5),)), (math.inf, float, math.inf)])
def test_numbers_of_other_libraries_become_plain(given: object, kind: object, made: object) -> None:
    value = plain("x", given, kind)
    assert value == made
    assert type(value) is type(made)


@pytest.mark.parametrize(("given", "kind", "told"), [
    (1.5, int, "x is 1.5; give an integer"), ("0", float, "x is '0'; give a number"), (True, int, "x is True; give an integer"),
    (np.True_, float, "give a number"), (1, bool, "x is 1; give True or False"), ("yes", bool, "give True or False"),
    (None, int, "x is None; give an integer"), ("0", float | None, "x is '0'; give a number or None"),
    (1 + 2j, float, "give a number"),
    (np.ones(1), float, "give a number"), (torch.ones(2), int, "give an integer"), (3.0, int, "give an integer"),
    ("c", Literal["a", "b"], "x is 'c'; choose a, b"), ((1,), tuple[int, int], "give 2 integers"),
    ("12", tuple[int, int], "give 2 integers"), (["a"], tuple[float, ...], "give a list of numbers"),
    (b"1", int, "give an integer")])
def test_other_things_are_refused_by_name(given: object, kind: object, told: str) -> None:
    with pytest.raises(OptionError) as refusal:
        plain("x", given, kind)
    assert told in str(refusal.value)


def every_configuration() -> None:
    found = list(configurations())
    assert len(found) > 35
    for config in found:
        assert issubclass(config, Checked), config
        needed = {f.name: "x" for f in dataclasses.fields(config)
                  if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING}
        for f in dataclasses.fields(config):
            if str(f.type).split(" ")[0] in {"int", "float", "bool"}:
                with pytest.raises(OptionError, match=f"^{f.name} is '0'; give "):
                    config(**needed | {f.name: "0"})


def requests_and_constraints() -> None:
    request = dro.GraspRequest(num=np.int64(3), seed=np.uint8(7), candidates=torch.tensor(2))
    assert (type(request.num), type(request.seed), type(request.candidates)) == (int, int, int)
    asked = dro.Constraints(
        direction=np.array([0, 0, -1.0]), table=np.float32(0), max_tilt=np.float64(0.5), pregrasp_clearance=torch.tensor(0.01))
    assert [type(v) for v in (asked.table, asked.max_tilt, asked.pregrasp_clearance)] == [float] * 3
    for wrong in ({"candidates": 1.5}, {"num": "4"}, {"refine": "no"}, {"seed": None}, {"temperature": "1"}):
        with pytest.raises(OptionError, match=f"^{next(iter(wrong))} is .*; give"):
            dro.GraspRequest(**wrong)
    for wrong in ({"table": "0"}, {"max_tilt": "0.5", "direction": (0, 0, -1)}, {"pregrasp_clearance": "0.01"}):
        with pytest.raises(OptionError, match=f"^{next(iter(wrong))} is '.*'; give a number"):
            dro.Constraints(**wrong)


def calls_of_the_package() -> None:
    hand = dro.load_hand("gripper3", seed=np.int64(0), n_points=np.int32(256))
    obj = dro.load_object("sphere", scale=np.float32(1))
    grasps = dro.palm_facing_starts(hand, obj, num=np.int64(2), seed=np.int64(3))
    assert grasps.seed.tolist() == [3, 3]
    predict = partial(dro.GraspPredictor.predict, SimpleNamespace(device="cpu", run=None), hand, obj)
    calls: list[tuple[Callable[[], object], str]] = [
        (lambda: dro.load_hand("gripper3", n_points="256"), "n_points is '256'"),
        (lambda: dro.load_object("sphere", scale="1"), "scale is '1'"),
        (lambda: dro.palm_facing_starts(hand, obj, num=1.5, seed=0), "num is 1.5"),
        (lambda: dro.synthesize(hand, obj, num=2, seed="0"), "seed is '0'"),
        (lambda: dro.simulate(hand, obj, grasps, workers=1.5), "workers is 1.5"),
        (lambda: dro.draw_grasps(hand, obj, grasps, "a.png", count="2"), "count is '2'"),
        (lambda: predict(num=1.5), "num is 1.5"), (lambda: predict(table="0"), "table is '0'"),
        (lambda: dro.make_hand(seed="1"), "seed is '1'"), (lambda: dro.plan(None, obj, seed=0.5), "seed is 0.5"),
        (lambda: dro.vary_hand("gripper3", factor="2"), "factor is '2'"),
        (lambda: dro.GraspClient(timeout="1"), "timeout is '1'")]
    for call, told in calls:
        with pytest.raises(OptionError, match=f"^{told}; give"):
            call()


@pytest.mark.usefixtures("as_users_have_it")
@pytest.mark.parametrize("check", [every_configuration, requests_and_constraints, calls_of_the_package])
def test_where_no_shapes_are_checked_numbers_are_told_from_texts(check: Callable[[], None]) -> None:
    check()


def test_functions_take_them_too() -> None:
    @checked
    def draw(where: str, count: int = 1, *, scale: float | None = None) -> tuple[str, int, float | None]:
        return where, count, scale

    assert draw("a", np.int64(2)) == ("a", 2, None)
    assert draw(where="a", scale=np.float32(0.5)) == ("a", 1, 0.5)
    with pytest.raises(OptionError, match="count is 'a'"):
        draw("a", "a")
    with pytest.raises(TypeError):
        draw("a", wrong=1)
    assert list(inspect.signature(draw).parameters) == ["where", "count", "scale"]
