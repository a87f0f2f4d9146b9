"""Confidence against outcomes: bins of what was drawn by it, and the price of a least one, counted by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from dro_grasp.compare.metrics import wilson_interval
from lab.calibration import price_of_least, reliability


def test_reliability_finds_what_was_drawn() -> None:
    """Outcomes drawn with the very confidence agree with it in each bin; with half of it they do not."""
    generator = torch.Generator().manual_seed(0)
    confidence = torch.rand(40_000, generator=generator)
    held = torch.rand(40_000, generator=generator) < confidence
    bins = reliability(confidence, held)
    assert [b["from"] for b in bins] == pytest.approx(np.arange(10) / 10)
    assert sum(b["n"] for b in bins) == 40_000
    for b in bins:
        rows = (confidence >= b["from"]) & (confidence < b["to"])
        assert b["n"] == int(rows.sum())
        assert b["observed"] == pytest.approx(float(held[rows].float().mean()))
        assert b["predicted"] == pytest.approx(float(confidence[rows].mean()))
        assert abs(b["observed"] - b["predicted"]) < 0.03
        assert (b["low"], b["high"]) == wilson_interval(int(held[rows].sum()), b["n"])
    doubtful = reliability(confidence, held & (torch.rand(40_000, generator=generator) < 0.5))
    assert abs(doubtful[-1]["observed"] - doubtful[-1]["predicted"]) > 0.4


def test_bins_take_the_ends_and_leave_out_what_is_empty() -> None:
    found = reliability(torch.tensor([0.0, 1.0]), torch.tensor([False, True]))
    assert [(b["from"], b["n"], b["observed"]) for b in found] == [(0.0, 1, 0.0), (0.9, 1, 1.0)]


def test_the_price_of_a_least_confidence_is_counted() -> None:
    confidence, held = torch.tensor([0.05, 0.15, 0.3, 0.8, 0.9]), torch.tensor([False, True, False, True, True])
    found = price_of_least(confidence, held, 0.2)
    assert found == pytest.approx({"least": 0.2, "held_lost": 1 / 3, "failing_dropped": 1 / 2, "hold_below": 1 / 2,
                                   "hold_above": 2 / 3})
    assert math.isnan(price_of_least(confidence, held, 0.0)["hold_below"])
