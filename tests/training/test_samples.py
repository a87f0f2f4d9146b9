"""How often each hand is drawn, and what a hand without grasps contributes."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from scipy.stats import kstest

from dro_grasp.cli.main import main
from dro_grasp.errors import OptionError
from dro_grasp.network.network import untrained_network
from dro_grasp.training.config import AugmentationConfig, LossConfig, PretrainConfig, TrainConfig
from dro_grasp.training.data.bundle.training_file import Bundle, write_bundle
from dro_grasp.training.pretraining import contrastive_step, posture_clouds
from dro_grasp.training.samples import SampleSource
from tests.helpers.tiny_bundle import SEMIAXES, TINY, ellipsoid, made_up_grasps
from tests.helpers.toy_hand import toy_hand


def source_of(counts: dict[str, int]) -> SampleSource:
    grasps = {name: SimpleNamespace(joints=torch.zeros(count, 1)) for name, count in counts.items()}
    source = SampleSource.__new__(SampleSource)
    source.grasps = grasps  # type: ignore[assignment]
    source.names, source.without = ([n for n, c in counts.items() if bool(c) == given] for given in (True, False))
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


def test_half_of_the_hands_of_a_step_of_pretraining_have_no_grasps() -> None:
    source, generator = source_of({"a": 2, "b": 300, "none": 0, "nor this": 0}), torch.Generator().manual_seed(0)
    found = Counter(name for _ in range(200) for name in source.draw_kinematics(4, generator))
    assert set(found.values()) == {200}, "all of the four, every time"
    assert all(set(source.draw_kinematics(2, generator)) & {"none", "nor this"} for _ in range(20))
    full = source_of({"a": 2, "b": 300})
    assert full.draw_kinematics(3, generator.manual_seed(1)) == full.draw_hands(3, generator.manual_seed(1))


@pytest.fixture
def mixed(tmp_path: Path) -> SampleSource:
    """The toy hand with grasps, and again without."""
    hand = toy_hand()
    more = dataclasses.replace(hand, name="more", sha256="more")
    bundle = write_bundle(tmp_path / "mixed.safetensors", [hand], {"ball": ellipsoid(SEMIAXES["ball"])}, [made_up_grasps(hand)],
                          without_grasps=[more])
    return SampleSource(bundle, TINY, AugmentationConfig())


def test_a_hand_without_grasps_takes_any_pose_within_its_limits(mixed: SampleSource) -> None:
    hand, generator = mixed.hands["more"], torch.Generator().manual_seed(0)
    T, joints, centre = mixed.draw_postures("more", 2000, generator)
    low, high = hand.tree.lower, hand.tree.upper
    share = ((joints - low) / (high - low)).numpy()
    assert min(kstest(column, "uniform").pvalue for column in share.T) > 1e-3
    torch.testing.assert_close(torch.linalg.inv(T)[:, :3, 3] + (T[:, :3, :3].mT @ centre[..., None])[..., 0],
                               hand.grasp_centre_wrist.expand(2000, 3), atol=1e-5, rtol=0)
    _, held, _ = mixed.draw_postures("toy", 50, generator)
    stored = mixed.grasps["toy"].joints
    assert bool((held[:, None] == stored).all(-1).any(-1).all()), "a hand with grasps takes theirs"


@pytest.mark.parametrize("frame", ["palm", "object"])
def test_pretraining_learns_from_hands_without_grasps(mixed: SampleSource, frame: str) -> None:
    network = dataclasses.replace(TINY, frame=frame)
    bundle = Bundle(mixed.hands, {"ball": ellipsoid(SEMIAXES["ball"])}, mixed.grasps)
    source, config = SampleSource(bundle, network, AugmentationConfig()), PretrainConfig(hands_per_step=2, samples_per_hand=3)
    encoder, seen = untrained_network(network, 0).hand_encoder, []
    encoder.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    loss = contrastive_step(encoder, posture_clouds(source, config, torch.Generator().manual_seed(0)), config)
    assert bool(loss.isfinite())
    assert seen[0].shape == (12, TINY.n_hand, 3), "three of each hand, grasping and open"


@pytest.mark.parametrize("value", [-0.1, 1.5, float("inf"), float("nan")])
def test_powers_that_say_nothing_are_refused(value: float) -> None:
    with pytest.raises(OptionError, match="by_count is"):
        TrainConfig(by_count=value)


@pytest.mark.parametrize(("make", "told"), [
    (lambda: TrainConfig(samples_per_hand=0), r"samples_per_hand is 0; give at least 1 \(samples_per_hand=...\)"),
    (lambda: TrainConfig(hands_per_step=0), "hands_per_step is 0"), (lambda: TrainConfig(columns=-1), "columns is -1"),
    (lambda: AugmentationConfig(partial=5.0), "partial is 5.0; give a share from 0 to 1"),
    (lambda: AugmentationConfig(object_noise=-0.1), "object_noise is -0.1"),
    (lambda: LossConfig(divergence=-1.0), "divergence is -1.0; give a number from 0 on"),
    (lambda: LossConfig(pose=math.nan), "pose is nan"), (lambda: LossConfig(flow=math.inf), "flow is inf"),
])
def test_settings_that_train_nothing_are_refused(make: Callable[[], object], told: str) -> None:
    with pytest.raises(OptionError, match=told):
        make()


@pytest.mark.parametrize(("command", "options", "told"), [
    ("pretrain", ["--motion-steps", "0"], "motion_steps is 0; give at least 1 (--motion-steps)"),
    ("train", ["--validation-samples", "0"], "validation_samples is 0; give at least 1 (--validation-samples)"),
    ("train", ["--columns", "0"], "(--columns)"), ("train", ["--divergence", "nan"], "divergence is nan"),
    ("train", ["--partial", "5"], "partial is 5.0"),
])
def test_commands_refuse_them_before_they_read_the_bundle(
    command: str, options: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = ["--bundle", "none.safetensors", "--run-folder", str(tmp_path / "run"), "--output", str(tmp_path / "w.safetensors")]
    assert main([command, *files, "--device", "cpu", *options]) == 2
    assert told in capsys.readouterr().err
