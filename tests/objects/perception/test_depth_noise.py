"""Noise of depth cameras against planes and steps of which everything is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from dro_grasp.errors import OptionError
from dro_grasp.objects.perception.depth_noise import PRESETS, DepthNoise, DepthView, depth_noise, edges, measured_depth, shadow

FOCAL = 400.0
INTRINSICS = np.array([[FOCAL, 0, 159.5], [0, FOCAL, 119.5], [0, 0, 1]])
SHAPE = (240, 320)
WHOLE = {"edge_loss": 0.0, "flying": 0.0, "steep": (math.pi / 2, math.pi / 2), "least_signal": 0.0, "baseline": 0.0}


def plane(depth: float, angle: float = 0.0) -> DepthView:
    """A plane through the optical axis at a depth [m], turned about the vertical by an angle [rad]."""
    column = np.broadcast_to((np.arange(SHAPE[1]) - 159.5) / FOCAL, SHAPE)
    normal = np.array([math.sin(angle), 0.0, -math.cos(angle)])
    image = depth * normal[2] / (column * normal[0] + normal[2])
    return DepthView(np.where(image > 0, image, 0.0), np.broadcast_to(normal, (*SHAPE, 3)).copy(), INTRINSICS)


def step(near: float, far: float, first: int = 120, last: int = 200) -> DepthView:
    """A board across some columns in front of a wall, both head on [m]."""
    image = np.full(SHAPE, far)
    image[60:180, first:last] = near
    return DepthView(image, np.broadcast_to((0.0, 0.0, -1.0), (*SHAPE, 3)).copy(), INTRINSICS)


def nguyen(z: float, angle: float) -> float:
    return 0.0012 + 0.0019 * (z - 0.4) ** 2 + 0.0001 / math.sqrt(z) * angle**2 / (math.pi / 2 - angle) ** 2


def fankhauser(z: float, angle: float) -> float:
    return 1e-3 * (1.5 - 0.5 * z + 0.3 * z**2 + 0.1 * z**1.5 * angle**2 / (math.pi / 2 - angle) ** 2)


def intel(z: float, angle: float) -> float:
    return z**2 * 0.08 / (1005 * 0.055)


@pytest.mark.parametrize(("name", "model"), [
    ("structured_light", nguyen), ("time_of_flight", fankhauser), ("stereo", intel)])
@pytest.mark.parametrize("depth", [0.6, 1.0, 2.0])
@pytest.mark.parametrize("angle", [0.0, 0.8, 1.2])
def test_the_deviation_on_planes_is_the_published_one(name: str, model, depth: float, angle: float) -> None:
    view, noise = plane(depth, angle), replace(PRESETS[name], edge_loss=0.0, flying=0.0)
    middle = (slice(None), slice(155, 165))  # where angle and depth are nearly those of the axis
    errors = [(measured_depth(view, noise, seed) - view.depth)[middle] for seed in range(12)]
    there = [measured_depth(view, noise, seed)[middle] > 0 for seed in range(12)]
    error = np.concatenate([e[t] for e, t in zip(errors, there, strict=True)])
    assert len(error) > 3000
    assert np.std(error) == pytest.approx(model(depth, angle), rel=0.12)
    assert abs(error.mean()) < 0.15 * model(depth, angle)


def test_a_plain_deviation_is_independent_from_pixel_to_pixel_and_what_it_was() -> None:
    view = plane(1.0)
    image = measured_depth(view, depth_noise(0.002), 3)
    assert np.array_equal(image, view.depth + np.random.default_rng(3).normal(0.0, 0.002, SHAPE))
    assert np.array_equal(measured_depth(view, depth_noise("none"), 3), view.depth)


def likeness(name: str, apart: int) -> float:
    error = measured_depth(plane(1.0), replace(PRESETS[name], **WHOLE | {"baseline": PRESETS[name].baseline}), 0) - 1.0
    return float(np.corrcoef(error[:, :-apart].ravel(), error[:, apart:].ravel())[0, 1])


def test_errors_of_stereo_are_alike_over_some_pixels_and_those_of_time_of_flight_are_not() -> None:
    width = PRESETS["stereo"].correlation * FOCAL / PRESETS["stereo"].focal
    for apart in (1, 2, 4):  # white noise after a Gaussian blur
        assert likeness("stereo", apart) == pytest.approx(math.exp(-apart**2 / (4 * width**2)), abs=0.06)
    assert abs(likeness("time_of_flight", 1)) < 0.02
    assert abs(likeness("stereo", 20)) < 0.1


@pytest.mark.parametrize("name", ["structured_light", "stereo"])
def test_depths_are_those_of_whole_steps_of_the_disparity(name: str) -> None:
    noise = replace(PRESETS[name], depth_step=0.0)
    depths = np.unique(measured_depth(plane(2.0), noise, 0))
    disparity = noise.focal * noise.baseline / depths[depths > 0] / noise.disparity_step
    assert np.abs(disparity - disparity.round()).max() < 1e-6
    gap = np.diff(depths[(depths > 1.98) & (depths < 2.02)]).min()
    assert gap == pytest.approx(noise.disparity_step * 2.0**2 / (noise.focal * noise.baseline), rel=0.03)
    stored = measured_depth(plane(2.0), PRESETS[name], 0)
    assert np.abs(stored * 1000 - np.round(stored * 1000)).max() < 1e-6


@pytest.mark.parametrize("baseline", [0.05, 0.075, -0.05])
def test_the_shadow_is_beside_the_board_and_as_wide_as_it_should_be(baseline: float) -> None:
    view = step(0.6, 1.0)
    hidden = shadow(view, baseline)
    width = FOCAL * abs(baseline) * (1 / 0.6 - 1 / 1.0)
    rows = hidden[70:170]
    assert rows.sum(1) == pytest.approx(width, abs=1.5)
    side = slice(120 - math.ceil(width) - 1, 120) if baseline > 0 else slice(200, 200 + math.ceil(width) + 1)
    assert rows[:, side].sum() == rows.sum(), "a sensor to the right does not see what is left of the board"
    assert not hidden[:55].any()
    assert not shadow(view, 0.0).any()
    assert not shadow(plane(1.0, 1.1), baseline).any(), "a plane hides nothing of itself"


def test_a_second_sensor_sees_past_a_thin_rod() -> None:
    view = step(0.6, 1.0, 160, 164)
    rows = shadow(view, 0.075)[100]
    middle = FOCAL * 0.075 * (1 / 0.6 - 1 / 1.0)
    assert rows.sum() == pytest.approx(4, abs=1.5)
    assert np.nonzero(rows)[0].mean() == pytest.approx(161.5 - middle, abs=1.5)


def test_flying_pixels_lie_between_the_two_surfaces_and_only_at_edges() -> None:
    view = step(0.6, 1.0)
    image = measured_depth(view, DepthNoise(flying=0.5), 0)
    between = (image > 0.601) & (image < 0.999)
    assert between.any()
    assert not (between & ~edges(view)).any()
    assert ((image >= 0.6 - 1e-12) & (image <= 1.0 + 1e-12)).all()
    assert between.sum() == pytest.approx(0.5 * edges(view).sum(), rel=0.15)
    assert np.quantile(image[between], [0.25, 0.75]) == pytest.approx([0.7, 0.9], abs=0.05)


def test_edges_are_where_surfaces_end_and_not_on_steep_planes() -> None:
    view = step(0.6, 1.0)
    expected = np.zeros(SHAPE, bool)
    expected[60:180, [119, 120, 199, 200]] = True
    expected[[59, 60, 179, 180], 120:200] = True
    assert np.array_equal(edges(view), expected)
    assert not edges(plane(1.0, 1.1)).any()


def test_lateral_noise_moves_edges_and_leaves_surfaces() -> None:
    view, noise = step(0.6, 1.0), DepthNoise(lateral=(1.5, 0.0), focal=FOCAL)
    image = measured_depth(view, noise, 0)
    moved = image != view.depth
    assert np.isin(image, (0.6, 1.0)).all()
    columns = np.nonzero(moved[80:160])[1]
    assert (np.minimum(np.abs(columns - 119.5), np.abs(columns - 199.5)) < 6).all()
    # A pixel right of an edge sees what is left of it if it is shifted by more than half a pixel.
    share = moved[80:160, [119, 120, 199, 200]].mean()
    assert share == pytest.approx(0.5 * math.erfc(0.5 / 1.5 / math.sqrt(2)), abs=0.06)
    slanted = plane(1.0, 1.1)
    assert np.array_equal(measured_depth(slanted, noise, 0), slanted.depth)


def test_dark_far_and_glancing_surfaces_are_lost() -> None:
    def share(view: DepthView, **settings) -> float:
        return float((measured_depth(view, DepthNoise(**settings), 0) == 0)[:, 150:170].mean())

    view = plane(1.0)
    assert share(replace(view, reflectance=np.full(SHAPE, 0.05)), least_signal=0.1) == pytest.approx(0.5, abs=0.08)
    assert share(replace(view, reflectance=np.full(SHAPE, 0.2)), least_signal=0.1) == 0
    assert share(plane(2.0), least_signal=0.25) == pytest.approx(0.5, abs=0.08)
    assert share(plane(1.0, 1.2), steep=(1.1, 1.3)) == pytest.approx(0.5, abs=0.1)
    assert share(plane(1.0, 1.0), steep=(1.1, 1.3)) == 0
    assert share(plane(1.0, 1.4), steep=(1.1, 1.3)) == 1
    board = step(0.6, 1.0)
    lost = measured_depth(board, DepthNoise(edge_loss=0.4), 0) == 0
    assert lost[edges(board)].mean() == pytest.approx(0.4, abs=0.08)
    assert not lost[~edges(board)].any()


@pytest.mark.parametrize("name", PRESETS)
def test_the_same_seed_gives_the_same_image_and_another_seed_another(name: str) -> None:
    view = step(0.6, 1.0)
    first = measured_depth(view, PRESETS[name], 5)
    assert np.array_equal(first, measured_depth(view, PRESETS[name], 5))
    assert np.array_equal(first, measured_depth(view, PRESETS[name], 6)) == (name == "none")
    empty = replace(view, depth=np.zeros(SHAPE))
    assert not measured_depth(empty, PRESETS[name], 0).any()


def test_noise_that_no_camera_has_is_refused() -> None:
    for wrong, word in (
        ({"flying": 1.2}, "shares"), ({"focal": 0.0}, "focal"), ({"subpixel": 0.1}, "baseline"), ({"glance": -1.0}, "negative"),
        ({"steep": (1.5, 1.0)}, "smaller")):
        with pytest.raises(OptionError, match=word):
            DepthNoise(**wrong)
    for given in ("sonar", -0.1, math.inf):
        with pytest.raises(OptionError, match="stereo"):
            depth_noise(given)
