"""Half-axes: their order, their directions, and the nearest one."""

from __future__ import annotations

import torch

from dro_grasp.frames import HALF_AXES, half_axis, half_axis_direction


def test_half_axes_are_in_order() -> None:
    axes = torch.tensor([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]).float()
    assert [HALF_AXES[i] for i in half_axis(axes + 0.2 * axes.roll(1, -1))] == ["+x", "-x", "+y", "-y", "+z", "-z"]
    assert torch.equal(torch.tensor([half_axis_direction(name) for name in HALF_AXES]), axes)
