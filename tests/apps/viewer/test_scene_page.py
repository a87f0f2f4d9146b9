"""The page of a scene: clicks, grasps of what was clicked, what is said; and (slow) a browser in which things are clicked."""

from __future__ import annotations

import io
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from playwright.sync_api import Page
from viser import UploadedFile

from dro_grasp.apps.viewer.scene_page import NO_GRASP, NO_THING, ScenePage
from dro_grasp.apps.viewer.scene_view import HOST, ServedPage
from dro_grasp.cli.main import main
from dro_grasp.errors import NoGraspError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.scenery import Scene, load_scene
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.predictor import GraspPredictor, Prediction
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.source import Progress
from tests.helpers.browser import free_port, page_of
from tests.helpers.made_scenes import MadeScene, make_scene, overlap, render_scene
from tests.helpers.weights import untrained_weights

pytestmark = pytest.mark.filterwarnings("default::DeprecationWarning", "default::ResourceWarning")


class Quick(GraspPredictor):
    """Makes three grasps without a network, in steps in which something else can be asked for."""

    started: threading.Event
    go_on: threading.Event
    asked: list[GraspProblem]
    fails = False

    def run(self, problem: GraspProblem, request: GraspRequest, progress: Progress | None = None) -> Prediction:
        self.asked.append(problem)
        self.started.set()
        assert self.go_on.wait(60)
        if progress is not None:
            progress(1, 2)
        if self.fails:
            raise NoGraspError("nothing is made")
        T = torch.eye(4).repeat(3, 1, 1)
        T[:, :3, 3] = torch.from_numpy(problem.obj.cloud.mean(0)) + torch.tensor([[0.0, 0, 0.1], [0.1, 0, 0.1], [0, 0.1, 0.1]])
        joints = problem.hand.canonical_joints(0.5).expand(3, -1)
        grasps = GraspBatch.create(problem.hand, problem.obj, T, joints, score=torch.tensor([2.0, 1.0, -1.0]))
        return Prediction(grasps, grasps, torch.zeros(3, 1, 3), ["mine"] * 3, 3, {}, {})


@pytest.fixture(scope="module")
def made() -> MadeScene:
    return make_scene("table", 3, 9, 1, width=320)


@pytest.fixture(scope="module")
def scene(made: MadeScene) -> Scene:
    return made.load()


@pytest.fixture
def page(scene: Scene, tmp_path: Path) -> Iterator[ScenePage]:
    served = ServedPage(free_port(), HOST)
    predictor = Quick(str(untrained_weights(tmp_path)))
    predictor.started, predictor.go_on, predictor.asked = threading.Event(), threading.Event(), []
    predictor.go_on.set()
    shown = ScenePage(served.server, predictor, scene, load_hand("gripper3"))
    yield shown
    predictor.go_on.set()
    shown.close()
    served.stop()


def number_of(made: MadeScene, scene: Scene, k: int) -> int:
    """Number of the thing of a made object."""
    assert scene.sight is not None
    own = made.owner.ravel()[scene.sight.pixels] == k
    return int(np.bincount(scene.segments.labels[own & (scene.segments.labels >= 0)]).argmax())


def aimed(page: ScenePage, point: np.ndarray) -> None:
    """A click on a point, seen from where the camera stood."""
    assert page.cloud.scene.sight is not None
    eye = page.cloud.scene.sight.T[:3, 3]
    page.click(eye, point - eye)


def seen(page: ScenePage, number: int) -> np.ndarray:
    """A point in the middle of what was seen of a thing."""
    own = page.cloud.world[page.cloud.labels == number]
    return own[np.linalg.norm(own - np.median(own, axis=0), axis=1).argmin()]


def test_a_click_takes_the_thing_that_is_seen_there(page: ScenePage, made: MadeScene, scene: Scene) -> None:
    assert f"shows {scene.segments.count} things" in page.status.content
    for k in range(len(made.names)):
        number = number_of(made, scene, k)
        aimed(page, seen(page, number))
        assert page.offer is not None, page.status.content
        assert page.offer.wish.number == number
        assert page.thing.value == page.thing.options[number + 1]
        assert (scene.segments.labels[page.offer.found.chosen.own] == number).all()
        assert isinstance(page.predictor, Quick)
        around = page.predictor.asked[-1].constraints.obstacles
        assert around is not None
        for other in range(scene.segments.count):  # all else is an obstacle
            if other != number:
                away = np.linalg.norm(around.points[:, None] - seen(page, other), axis=-1).min()
                assert away < 0.02
    assert "**3 grasps** of thing" in page.status.content


def test_a_click_takes_one_side_of_things_that_touch(page: ScenePage) -> None:
    boxes = [trimesh.creation.box(bounds=box) for box in (
        ((-0.04, -0.07, 0.0), (0.04, 0.07, 0.06)), ((0.04, -0.03, 0.0), (0.10, 0.03, 0.16)))]
    made = render_scene("table", boxes, ("low", "tall"), np.random.default_rng(0), 2)
    page.open(made.load())
    assert page.cloud.scene.segments.count == 1
    aimed(page, np.array([0.07, 0.0, 0.155]))
    assert page.offer is not None
    assert len(page.offer.found.chosen.own) == (page.cloud.labels == 0).sum()
    page.one_side.value = True
    for k, place in enumerate(((0.0, 0.0, 0.06), (0.07, 0.0, 0.155))):
        aimed(page, np.array(place))
        assert overlap(made, k, page.offer.found.chosen.pixels) > 0.8
        assert isinstance(page.predictor, Quick)
        assert page.predictor.asked[-1].constraints.obstacles is not None
    page._other()  # other grasps of the same side
    assert overlap(made, 1, page.offer.found.chosen.pixels) > 0.8
    page.predictor.fails = True
    aimed(page, np.array([0.0, 0.0, 0.06]))
    assert page.offer is None
    page.predictor.fails = False
    aimed(page, np.array([0.0, 0.01, 0.06]))  # once more: other draws
    assert page.offer is not None
    assert page.offer.wish.seed == 1
    assert overlap(made, 0, page.offer.found.chosen.pixels) > 0.8
    page.one_side.value = False
    aimed(page, np.array([0.07, 0.0, 0.155]))
    assert page.offer.wish.side is None


def test_grasps_are_ranked_and_one_is_shown(page: ScenePage) -> None:
    page.pick(0)
    offer = page.offer
    assert offer is not None
    assert page.grasp.options == ("1: 88% sure", "2: 73% sure", "3: 27% sure")
    assert "|**1**|**88%**|" in page.text.content
    assert page.hand_view._root.visible
    wrist = page.marks.wrists[2]
    page.click(wrist + np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.0, -1.0]))
    assert page.grasp.value == page.grasp.options[2]
    assert "|**3**|**27%**|" in page.text.content
    expected = offer.grasps.T_object_wrist[2] @ page.hand.tree.forward(offer.grasps.joints[2].float())
    np.testing.assert_allclose(page.hand_view._links[0].position, expected[0, :3, 3], atol=1e-5)


def test_words_say_what_was_clicked_where_it_is_no_thing(page: ScenePage) -> None:
    eye = page.cloud.world.mean(0) + np.array([0.0, 0.0, 1.0])
    page.click(eye, np.array([0.0, 0.0, 1.0]))
    assert "Nothing is there" in page.status.content
    flat = page.cloud.world[page.cloud.labels == -2]
    away = np.linalg.norm(flat[:, None] - page.cloud.world[page.cloud.labels >= 0][::40], axis=-1).min(1)
    aimed(page, flat[away.argmax()])
    assert "That is a table" in page.status.content
    page.click(eye, np.array([np.nan, 0.0, 1.0]))
    page.click(eye, np.zeros(3))
    page.cloud.labels = np.where(page.cloud.labels == -2, -1, page.cloud.labels)
    aimed(page, flat[away.argmax()])
    assert "taken for no thing" in page.status.content
    assert page.offer is None


def test_a_click_while_grasps_are_made_takes_the_other_thing(page: ScenePage) -> None:
    assert isinstance(page.predictor, Quick)
    page.predictor.go_on.clear()
    work = threading.Thread(target=lambda: page.pick(0))
    work.start()
    assert page.predictor.started.wait(60)
    aimed(page, seen(page, 0))
    assert "is taken already" in page.status.content
    page.pick(1)
    assert "what goes on for another one is given up" in page.status.content
    page.predictor.go_on.set()
    work.join(60)
    assert page.offer is not None
    assert page.offer.wish.number == 1
    assert len(page.predictor.asked) == 2
    page.thing.value = NO_THING
    page._listed()
    assert page.offer is None
    assert page.grasp.options == (NO_GRASP,)


def test_another_scene_while_grasps_are_made(page: ScenePage, tmp_path: Path) -> None:
    assert isinstance(page.predictor, Quick)
    page.predictor.go_on.clear()
    work = threading.Thread(target=lambda: page.pick(0))
    work.start()
    assert page.predictor.started.wait(60)
    x, y = np.meshgrid(np.arange(-0.4, 0.4, 0.005), np.arange(-0.3, 0.3, 0.005))
    np.save(tmp_path / "bare.npy", np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1))
    upload = UploadedFile("bare.npy", (tmp_path / "bare.npy").read_bytes())
    other = threading.Thread(target=lambda: page._take_scene(upload))
    other.start()
    time.sleep(0.2)
    page.predictor.go_on.set()
    work.join(60)
    other.join(60)
    assert page.offer is None
    assert "shows no thing" in page.status.content
    assert page.thing.options == (NO_THING,)
    page.click(np.array([0.0, 0, 1]), np.array([0.0, 0, -1]))
    assert "That is a table" in page.status.content
    page._take_scene(UploadedFile("nothing.npy", b"nothing"))
    assert "**It did not work:**" in page.status.content
    assert "/tmp" not in page.status.content


def test_an_upload_waits_however_long_and_a_mesh_leaves_all_as_it_is(page: ScenePage, tmp_path: Path) -> None:
    page.pick(0)
    offer, wish = page.offer, page._wish
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "box.stl")
    page._take_scene(UploadedFile("box.stl", (tmp_path / "box.stl").read_bytes()))
    assert "**It did not work:**" in page.status.content
    assert (page.offer, page._wish) == (offer, wish)
    begun, go_on = threading.Event(), threading.Event()
    work = threading.Thread(target=lambda: page._guarded(lambda: (begun.set(), go_on.wait(60))))
    work.start()
    assert begun.wait(20)
    x, y = np.meshgrid(np.arange(-0.4, 0.4, 0.005), np.arange(-0.3, 0.3, 0.005))
    np.save(tmp_path / "bare.npy", np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1))
    page._take_scene(UploadedFile("bare.npy", (tmp_path / "bare.npy").read_bytes()))
    go_on.set()
    work.join(60)
    assert page.cloud.scene.name == "bare.npy"


def test_what_fails_is_told_and_a_click_tries_again(page: ScenePage) -> None:
    assert isinstance(page.predictor, Quick)
    page.predictor.fails = True
    page.pick(0)
    assert "**It did not work:** nothing is made" in page.status.content
    page.predictor.fails = False
    aimed(page, seen(page, 0))
    assert page.offer is not None
    assert page.offer.wish.seed == 1
    page._other()
    assert page.offer is not None
    assert page.offer.wish.seed == 2


def test_clouds_of_a_few_points_are_shown(page: ScenePage) -> None:
    for points in (np.zeros((1, 3)), np.random.default_rng(0).normal(size=(30, 3))):
        page.open(load_scene(points, "few"))
        assert "shows no thing" in page.status.content
        page.click(np.array([0.0, 0, 3.0]), np.array([0.0, 0, -1.0]))


def test_a_page_that_is_closed_hears_nothing(page: ScenePage) -> None:
    page.close()
    page.click(np.array([0.0, 0, 1]), np.array([0.0, 0, -1]))
    page.pick(0)
    assert page.offer is None


def written(made: MadeScene, folder: Path) -> tuple[Path, Path]:
    """A made scene as depth image in millimetres, and its camera."""
    depth, camera = folder / "depth.png", folder / "camera.json"
    Image.fromarray((1000 * np.nan_to_num(made.depth)).round().astype(np.uint16)).save(depth)
    assert made.camera.intrinsics is not None
    camera.write_text(json.dumps({"frame": "world", "T_frame_camera": made.camera.T_frame_camera.tolist(),
                                  "intrinsics": made.camera.intrinsics.tolist()}))
    return depth, camera


@pytest.mark.parametrize(("given", "told"), [
    (("--camera", "camera.json"), "--camera is that of a scene"),
    (("grasps.parquet", "--scene", "depth.png"), "--scene and FILE are given"),
    (("--object", "mug", "--scene", "depth.png"), "--scene and --object are given"),
    (("--robot", "xarm7_leaphand", "--hand", "allegro", "--scene", "depth.png"), "the robot has a hand"),
    (("--camera", "robot", "--scene", "depth.png"), "name the robot, too"),
    (("--scene", "depth.png"), "is a depth image; give its camera"),
    (("--robot", "xarm7_leaphand"), "--robot is for motions of an arm, or for --scene; leave it out"),
    (("--attempt", "3"), "--attempt is for motions of an arm"),
    (("--scene", "depth.png", "--attempt", "5"), "--attempt is for attempts of an arm, which are in a file; leave it out"),
    (("plan.npz", "--scale", "-1", "--device", "tpu"), "--scale and --device are for grasps, and the file holds a motion"),
    (("plan.npz", "--attempt", "7", "--weights", "nope"), "--attempt and --weights are for attempts, and the file holds none"),
    (("grasps.parquet", "--scale", "2"), "name the object, too: --object NAME|PATH"),
])
def test_options_that_contradict_one_another_are_refused(
    made: MadeScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    given: tuple[str, ...], told: str
) -> None:
    written(made, tmp_path)
    monkeypatch.chdir(tmp_path)
    assert main(["view", *given, "--port", str(free_port())]) == 2
    assert told in capsys.readouterr().err


@pytest.mark.slow
def test_a_browser_clicks_a_thing_and_sees_its_grasps(made: MadeScene, tmp_path: Path) -> None:
    depth, camera = written(made, tmp_path)
    with page_of("--scene", str(depth), "--camera", str(camera), "--hand", "gripper3", size=(1280, 860)) as page:
        page.get_by_text("Click a thing").first.wait_for(timeout=120_000)
        time.sleep(5)
        page.mouse.click(*on_a_thing(page))
        page.get_by_text("the surest first; ").wait_for(timeout=300_000)
        page.get_by_text("carries").wait_for(timeout=60_000)
        page.screenshot(path=tmp_path / "page.png", timeout=300_000)
    assert (tmp_path / "page.png").stat().st_size > 20_000


def on_a_thing(page: Page) -> tuple[float, float]:
    """A place on the canvas that is as blue as a thing."""
    picture = Image.open(io.BytesIO(page.screenshot(timeout=300_000)))
    pixels = np.asarray(picture.convert("RGB")).astype(int)
    blue = (pixels[..., 2] > 100) & (pixels[..., 2] - pixels[..., 0] > 70) & (np.arange(pixels.shape[1]) < 900)
    rows, columns = np.nonzero(blue)
    middle = np.array([np.median(columns), np.median(rows)])
    nearest = np.hypot(columns - middle[0], rows - middle[1]).argmin()
    return float(columns[nearest]), float(rows[nearest])
