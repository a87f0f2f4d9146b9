"""What the run-time type checker refuses."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from jaxtyping import Float, TypeCheckError, jaxtyped
from torch import Tensor

from tests.helpers import typecheck
from tests.helpers.typecheck import Unlike, check, likeness


@jaxtyped(typechecker=check)
def repeated(row: Float[Tensor, " n"], count: int, wrong: int = 0) -> Float[Tensor, "_ n"]:
    return row.expand(count, -1)[:, wrong:]


@jaxtyped(typechecker=check)
def shown(row: Float[Tensor, "3"], ending: str = "") -> None:
    return ending or None


def test_fitting_arguments_and_results_pass() -> None:
    assert repeated(torch.zeros(4), 2).shape == (2, 4)
    assert repeated(torch.zeros(5), count=1).shape == (1, 5), "every call has sizes of its own"
    assert shown(torch.zeros(3)) is None


@pytest.mark.parametrize(
    "arguments", [(torch.zeros(4, 1), 2), (torch.zeros(4, dtype=torch.int), 2), ([0.0], 2), (torch.zeros(4), 2.0)])
def test_arguments_are_refused(arguments: tuple) -> None:
    with pytest.raises(TypeCheckError, match=r"parameters of .*repeated"):
        repeated(*arguments)
    with pytest.raises(TypeCheckError, match=r"parameters of .*shown"):
        shown(*arguments)


def test_results_are_refused_also_for_sizes_that_only_the_arguments_tell() -> None:
    with pytest.raises(TypeCheckError, match=r"return value of .*repeated"):
        repeated(torch.zeros(4), 2, wrong=1)
    with pytest.raises(TypeCheckError, match=r"return value of .*shown"):
        shown(torch.zeros(3), "done")


def test_a_call_like_one_before_is_not_checked_again_and_any_other_is(monkeypatch: pytest.MonkeyPatch) -> None:
    looked = []
    checked = typecheck._checked

    def counting(function):
        made = checked(function)
        return lambda *a, **k: (looked.append(function.__name__), made(*a, **k))[1]

    monkeypatch.setattr(typecheck, "_checked", counting)

    @typecheck.jaxtyped(typechecker=check)
    def part(row: Float[Tensor, " n"], wrong: list[int], least: float = 0.0) -> Float[Tensor, " n"]:
        return row[wrong[0]:] if least < 1.0 else row[:, None]

    for _ in range(3):
        part(torch.zeros(4), [0])
    assert len(looked) == 2, "arguments and result, each once"
    with pytest.raises(TypeCheckError, match="return value"):
        part(torch.zeros(4), [0], 1.5)
    part(torch.zeros(4), [0], 0.5)
    with pytest.raises(TypeCheckError, match="return value"):
        part(torch.zeros(4), [0], 1.5)
    for bad in (torch.zeros(4, 1), torch.zeros(4, dtype=torch.int), [0.0]):
        with pytest.raises(TypeCheckError, match="parameters"):
            part(bad, [0])
    with pytest.raises(TypeCheckError, match="return value"):
        part(torch.zeros(4), [1])


@pytest.mark.parametrize(
    ("value", "other"),
    [
        (torch.zeros(3), torch.zeros(4)), (torch.zeros(3), torch.zeros(3, dtype=torch.int)), (torch.zeros(3), np.zeros(3)),
        (1, 2), (1, True), (1, 1.0), ("a", "b"), (None, "None"), ([1, "a"], [1, 1]), ([1], (1,)), ({"a": 1}, {"a": None}),
        (int, str),
        ((torch.zeros(3), torch.zeros(2)), (torch.zeros(2), torch.zeros(3))),
    ],
)
def test_what_a_check_can_tell_apart_is_unlike(value: object, other: object) -> None:
    assert likeness(value) != likeness(other)
    assert likeness(value) == likeness(copy.deepcopy(value))


@pytest.mark.parametrize("value", [[0] * 17, {1, 2}, iter([1]), {"a": iter([1])}])
def test_other_containers_are_always_checked(value: object) -> None:
    with pytest.raises(Unlike):
        likeness(value)
