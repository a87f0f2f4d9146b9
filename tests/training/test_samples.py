"""How often each hand is drawn."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace

import pytest
import torch

from dro_grasp.errors import OptionError
from dro_grasp.training.config import LossConfig, TrainConfig
from dro_grasp.training.samples import SampleSource


def source_of(counts: dict[str, int]) -> SampleSource:
    grasps = {name: SimpleNamespace(joints=torch.zeros(count, 1)) for name, count in counts.items()}
    source = SampleSource.__new__(SampleSource)
    source.names, source.grasps = list(counts), grasps  # type: ignore[assignment]
    return source


@pytest.mark.parametrize(
    ("by_count", "expected"), [(0.0, (1 / 3, 1 / 3, 1 / 3)), (0.5, (1 / 7, 2 / 7, 4 / 7)), (1.0, (1 / 21, 4 / 21, 16 / 21))])
def test_hands_are_drawn_by_the_number_of_their_grasps(by_count: float, expected: tuple[float, ...]) -> None:
    source, generator = source_of({"few": 1, "some": 4, "many": 16}), torch.Generator().manual_seed(0)
    found = Counter(source.draw_hands(1, generator, by_count)[0] for _ in range(4000))
    assert [found[name] / 4000 for name in source.names] == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize("by_count", [0.0, 0.5])
def test_a_step_has_different_hands_and_repeats_them_only_where_there_are_too_few(by_count: float) -> None:
    source, generator = source_of({"a": 2, "b": 300, "c": 5}), torch.Generator().manual_seed(0)
    for _ in range(20):
        assert len(set(source.draw_hands(3, generator, by_count))) == 3
        assert sorted(Counter(source.draw_hands(5, generator, by_count)).values()) == [1, 2, 2]


@pytest.mark.parametrize("value", [-0.1, 1.5, float("inf"), float("nan")])
def test_powers_and_weights_that_say_nothing_are_refused(value: float) -> None:
    with pytest.raises(OptionError, match="by_count is"):
        TrainConfig(by_count=value)
    if value != 1.5:
        with pytest.raises(OptionError, match="drawn is"):
            TrainConfig(losses=LossConfig(drawn=value))
