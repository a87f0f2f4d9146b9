"""Devices: those that are asked for must be there, and records move whole."""

from __future__ import annotations

import pytest
import torch

from dro_grasp.devices import choose_device, on_device, require_device
from dro_grasp.energy.grasp_energy import link_spheres
from dro_grasp.errors import OptionError
from tests.helpers.toy_hand import toy_hand


@pytest.mark.parametrize("there", [True, False])
def test_the_device_is_cuda_where_there_is_one(monkeypatch: pytest.MonkeyPatch, there: bool) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)
    assert choose_device("auto") == ("cuda" if there else "cpu")
    assert choose_device("cpu") == "cpu"
    if there:
        assert choose_device("cuda:1") == "cuda:1"
    else:
        with pytest.raises(OptionError, match=r"device is 'cuda:1'.*use --device cpu"):
            require_device("cuda:1")


def test_records_move_with_what_is_in_them() -> None:
    hand = toy_hand()
    moved = hand.to("meta")
    assert {moved.link_points.device.type, moved.tree.origin.device.type, moved.opening.device.type} == {"meta"}
    assert moved.tree.link_names == hand.tree.link_names
    assert hand.link_points.device.type == "cpu"
    assert hand.to("cpu") is hand
    spheres = on_device(link_spheres(hand), "meta")
    assert {spheres.centres.device.type, spheres.pairs.device.type} == {"meta"}
