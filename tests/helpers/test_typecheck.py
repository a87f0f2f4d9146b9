"""What the run-time type checker refuses."""

from __future__ import annotations

import pytest
import torch
from jaxtyping import Float, TypeCheckError, jaxtyped
from torch import Tensor

from tests.helpers.typecheck import check


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
