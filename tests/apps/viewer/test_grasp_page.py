"""The viewer: what it shows, to whom, and (slow) that a browser really shows it."""

from __future__ import annotations

import contextlib
import io
import socket
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import torch

from dro_grasp.apps.viewer import grasp_page as page_module
from dro_grasp.apps.viewer.grasp_page import GraspViewer, describe, postures_of
from dro_grasp.apps.viewer.scene_view import HOST, ServedPage, viewpoint
from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.geometry.rendering.rasterizer import Camera
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.pictures.appearance import success_colour
from tests.helpers.browser import free_port, page_of
from tests.helpers.loaded_hands import loaded_hand

pytestmark = pytest.mark.filterwarnings("default::DeprecationWarning", "default::ResourceWarning")


@pytest.fixture(scope="module")
def grasps() -> GraspBatch:
    hand, obj = loaded_hand("gripper3"), load_object("sphere")
    T = torch.eye(4).repeat(2, 1, 1)
    T[:, :3, 3] = -hand.grasp_centre_wrist
    return GraspBatch.create(
        hand, obj, T, hand.canonical_joints(0.6).expand(2, -1), score=torch.tensor([1.5, -2.0]),
        success=torch.tensor([True, False]), protocol=("dro/1", "dro/1"), displacement=torch.tensor([0.004, 0.5]),
    )


@pytest.fixture(scope="module")
def viewer(grasps: GraspBatch):
    hand, obj = loaded_hand("gripper3"), load_object("sphere")
    points = hand.points(grasps.joints, grasps.T_object_wrist)
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        viewer = GraspViewer(hand, obj, grasps, points + 0.001, port=free_port())
    assert said.getvalue() == "", "stdout belongs to tables and JSON"
    yield viewer
    viewer.stop()


def test_links_stand_where_kinematics_puts_them(viewer: GraspViewer, grasps: GraspBatch) -> None:
    from dro_grasp.geometry.se3 import roma

    hand = loaded_hand("gripper3")
    for posture, joints in postures_of(hand, load_object("sphere"), grasps).items():
        viewer.show(1, posture)
        poses = grasps.T_object_wrist[1] @ hand.tree.forward(joints[1])
        for frame, pose in zip(viewer.view.links, poses, strict=True):
            assert np.allclose(frame.position, pose[:3, 3], atol=1e-6)
            shown = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(torch.tensor(np.asarray(frame.wxyz)).float()))
            assert torch.allclose(shown, pose[:3, :3], atol=1e-5)


def test_points_and_colours_follow_the_grasp(viewer: GraspViewer, grasps: GraspBatch) -> None:
    hand = loaded_hand("gripper3")
    for index in (0, 1):
        viewer.show(index, "grasp")
        solved = hand.points(grasps.joints[index], grasps.T_object_wrist[index])
        assert np.allclose(viewer.view.solved.points, solved, atol=1e-5)
        assert np.allclose(viewer.view.predicted.points, solved + 0.001, atol=1e-5)
        wanted = tuple(round(255 * c) for c in success_colour(bool(grasps.success[index])))
        assert tuple(viewer.view._grid.cell_color) == wanted
        assert f"Grasp {index}" in viewer.text.content


def test_postures_open_and_close(grasps: GraspBatch) -> None:
    hand, obj = loaded_hand("gripper3"), load_object("sphere")
    joints = postures_of(hand, obj, grasps)
    spread = {
        name: (hand.points(q, grasps.T_object_wrist) - torch.from_numpy(obj.centre_of_mass).float())
        .norm(dim=-1).mean() for name, q in joints.items()
    }
    assert spread["pregrasp"] > spread["grasp"] > spread["squeeze"]


def test_layers_are_shown_as_the_controls_say(viewer: GraspViewer) -> None:
    viewer.show(0, "grasp")
    assert (viewer.view.links[0].visible, viewer.view.solved.visible, viewer.view.predicted.visible) == (True, False, False)
    viewer.shapes.value, viewer.points.value, viewer.predicted.value = False, True, True
    assert (viewer.view.links[0].visible, viewer.view.solved.visible, viewer.view.predicted.visible) == (False, True, True)
    viewer.shapes.value, viewer.points.value, viewer.predicted.value = True, False, False


def test_a_grasp_that_takes_long_is_not_drawn_over_a_later_one(viewer: GraspViewer, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, go_on, honest = threading.Event(), threading.Event(), page_module.postures_of

    def slow(hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> dict[str, torch.Tensor]:
        if float(grasps.score[0]) > 0:  # the first
            begun.set()
            assert go_on.wait(20)
        return honest(hand, obj, grasps)

    viewer.show(1, "grasp")
    monkeypatch.setattr(page_module, "postures_of", slow)
    older = threading.Thread(target=lambda: setattr(viewer.slider, "value", 0))
    older.start()
    assert begun.wait(20)
    viewer.slider.value = 1
    go_on.set()
    older.join(20)
    assert "Grasp 1" in viewer.text.content


def test_a_film_of_another_stage_is_not_kept(viewer: GraspViewer, monkeypatch: pytest.MonkeyPatch) -> None:
    honest = page_module.record

    def slow(*given: object) -> object:
        monkeypatch.setattr(viewer, "_batch", lambda: viewer.made.refined[[0, 1]])  # as when another stage is chosen
        return honest(*given)

    monkeypatch.setattr(page_module, "record", slow)
    viewer.show(0, "grasp")
    viewer._play()
    assert viewer.film is None


def test_only_this_machine_is_served(viewer: GraspViewer) -> None:
    assert viewer.server.get_host() == HOST == "127.0.0.1"
    assert viewer.url.startswith("http://127.0.0.1:")


@pytest.mark.skipif(not socket.has_ipv6, reason="needs IPv6")
def test_addresses_of_the_newer_kind_are_served() -> None:
    served = ServedPage(free_port(), "::1")
    try:
        assert served.url == f"http://[::1]:{served.server.get_port()}"
        with urllib.request.urlopen(served.url, timeout=20) as answer:
            assert answer.status == 200
    finally:
        served.stop()


@pytest.mark.parametrize(("port", "host", "cause"), [
    (0, HOST, "port is 0"), (-1, HOST, "port is -1"), (65536, HOST, "65536"), (8080, "999.1.1.1", "999.1.1.1"),
    (8080, "192.0.2.1", "192.0.2.1"),
])
def test_impossible_addresses_are_refused_at_once(port: int, host: str, cause: str) -> None:
    with pytest.raises(OptionError, match=cause):
        ServedPage(port, host)


def test_text_says_what_is_known(grasps: GraspBatch) -> None:
    assert describe(grasps, 0).splitlines()[1].startswith("**success** under dro/1")
    assert "failed" in describe(grasps, 1)
    assert "displacement 4.00 mm" in describe(grasps, 0)
    assert "robustness" not in describe(grasps, 0)
    assert "not evaluated" in describe(grasps.without_trial(), 0)
    n = len(grasps)
    several = grasps.replace(robustness=torch.full((n,), 0.75), fingers_in_contact=torch.full((n,), 3.0))
    assert describe(several, 0).endswith("robustness 75.00 %  \nfingers in contact 3")
    unknown = torch.full((n,), torch.nan)
    silent = grasps.replace(payload=unknown, squeeze_force=unknown)
    assert "carries" not in describe(silent, 0)
    known = silent.replace(payload=torch.full((n,), 0.8), squeeze_force=torch.full((n,), 6.25))
    assert "carries 0.8 kg, squeezes with 6.2 N" in describe(known, 0).splitlines()[-1]


def test_narrow_windows_are_seen_from_farther_away_and_above_the_panel() -> None:
    camera = Camera((0.3, 0.4, 0.0), (0.0, 0.0, 0.0))
    apart = []
    for aspect in (4 / 3, 16 / 9, 390 / 844):
        position, target = map(np.asarray, viewpoint(camera, aspect))
        apart.append(np.linalg.norm(position - target))
        # What the picture has in its middle, in the window: 0 is the middle, 0.5 the upper edge.
        raised = -target[2] / (2 * apart[-1] * np.tan(camera.field_of_view / 2))
        assert raised == pytest.approx(0.27 if aspect < 1 else 0.0)
    wide, wider, phone = apart
    assert wide == wider
    # The horizontal half-angle of the narrow window sees what that of the picture sees.
    assert phone / wide == pytest.approx((4 / 3) / (390 / 844))


def test_nothing_to_show_and_foreign_hands_are_refused(grasps: GraspBatch) -> None:
    hand, obj = loaded_hand("gripper3"), load_object("sphere")
    with pytest.raises(OptionError, match="no grasp"):
        GraspViewer(hand, obj, grasps[slice(0, 0)])
    with pytest.raises(GraspFileError, match="gripper3"):
        GraspViewer(hand, obj, grasps.replace(wrist_link="other"))


@pytest.mark.slow
def test_a_browser_shows_the_grasp(grasps: GraspBatch, tmp_path: Path) -> None:
    file = tmp_path / "grasps.parquet"
    grasps.save(file)
    with page_of(str(file), size=(1000, 700)) as page:
        page.get_by_text("success under dro/1").wait_for(timeout=60_000)
        page.get_by_text("Hand points").click(timeout=60_000)
        time.sleep(4)
        page.screenshot(path=str(tmp_path / "viewer.png"), timeout=300_000)
    from PIL import Image

    with Image.open(tmp_path / "viewer.png") as file_:
        picture = np.asarray(file_.convert("RGB"))[:, :650].reshape(-1, 3).astype(int)
    warm = (picture[:, 0] > picture[:, 2] + 60).mean()
    assert warm > 0.005, "the object is to be seen"
