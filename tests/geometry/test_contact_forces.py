"""Forces at contacts against SciPy's solver, and friction cones against their definition."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize
import torch

from dro_grasp.geometry.contact_forces import friction_cone, nonnegative_least_squares


def test_least_squares_as_in_scipy() -> None:
    generator = np.random.default_rng(0)
    a, b = generator.normal(size=(20, 9, 14)), generator.normal(size=(20, 9))
    found = nonnegative_least_squares(torch.from_numpy(a), torch.from_numpy(b), 0.01, 3000).numpy()
    for one, matrix, target in zip(found, a, b, strict=True):
        rows = np.concatenate([matrix, 0.1 * np.eye(14)])
        exact = scipy.optimize.nnls(rows, np.concatenate([target, np.zeros(14)]))[0]
        np.testing.assert_allclose(one, exact, atol=2e-3)
    assert (found == 0).mean() > 0.2


@pytest.mark.parametrize("inward", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.6, 0.0, -0.8), (0.48, 0.6, 0.64)])
def test_the_edges_of_a_cone_lean_as_far_as_friction_allows_evenly_around(inward: tuple[float, float, float]) -> None:
    axis = torch.tensor(inward)
    edges = friction_cone(axis, 0.4, 6)
    torch.testing.assert_close(edges @ axis, torch.ones(6))
    around = edges - axis
    torch.testing.assert_close(around.norm(dim=-1), torch.full((6,), 0.4))
    torch.testing.assert_close((around * around.roll(1, 0)).sum(-1) / 0.16, torch.full((6,), 0.5))


def test_several_targets_of_a_matrix_are_answered_as_each_alone() -> None:
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(5, 9, 14, generator=generator), torch.randn(5, 9, 3, generator=generator)
    together = nonnegative_least_squares(a, b, 0.01, 50)
    assert together.shape == (5, 14, 3)
    for column, alone in enumerate(b.unbind(-1)):
        torch.testing.assert_close(together[..., column], nonnegative_least_squares(a, alone, 0.01, 50))
