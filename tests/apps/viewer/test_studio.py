"""The page that makes grasps: its parts called as the browser calls them, and (slow) a browser that uses it from end to end."""

from __future__ import annotations

import asyncio
import gc
import io
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
import trimesh
import viser
import websockets
import yaml

from dro_grasp.apps.viewer import grasp_page as module
from dro_grasp.apps.viewer.grasp_page import EXPORTS, GraspViewer, chosen, exported, postures_of
from dro_grasp.apps.viewer.scene_view import HOST, ServedPage
from dro_grasp.apps.viewer.studio import Studio, StudioServer
from dro_grasp.cli.view import View
from dro_grasp.errors import HandError, OptionError
from dro_grasp.frames import HALF_AXES, half_axis_direction
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import CONTACT_LINKS, REASON
from dro_grasp.hands.library import BUILTIN_FOLDER, load_hand
from dro_grasp.objects.builtin import BUILTIN
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.predictor import GraspPredictor
from tests.helpers.browser import free_port, page_of, use
from tests.helpers.served_studio import served_studio, visited
from tests.helpers.weights import untrained_weights

pytestmark = pytest.mark.filterwarnings("default::DeprecationWarning", "default::ResourceWarning")


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory):
    with served_studio(tmp_path_factory.mktemp("weights")) as made:
        yield made


@pytest.fixture(scope="module")
def made(studio: Studio) -> module.ShownGrasps:
    studio.num.value = 6
    studio._guarded(studio._generate)
    assert studio.made is not None, studio.status.content
    return studio.made


def test_it_starts_empty_and_for_this_machine_alone(studio: Studio) -> None:
    assert isinstance(studio.client, viser.ViserServer)
    assert studio.client.get_host() == "127.0.0.1"
    if studio.made is None:
        assert "gripper3 above sphere" in studio.status.content
        assert studio.view.hand is not None, "the hand is shown at once"


def test_generating_shows_the_best_and_says_what_held(studio: Studio, made: module.ShownGrasps) -> None:
    assert len(made.refined) == len(made.raw) == 6
    scores = made.refined.score.tolist()
    assert scores == sorted(scores, reverse=True)
    assert f"**{int(made.refined.success.sum())}** held" in studio.status.content
    assert "Grasp 0" in studio.text.content
    assert "posture: held" in studio.text.content
    studio.posture.value = "grasp"
    assert "posture: grasp" in studio.text.content
    expected = made.refined.T_object_wrist[0] @ made.hand.tree.forward(made.refined.joints[0])
    np.testing.assert_allclose(studio.view.links[0].position, expected[0, :3, 3], atol=1e-5)
    studio.stage_of.value = "network"
    studio._show()
    np.testing.assert_allclose(studio.view.links[0].position, made.raw.T_object_wrist[0, :3, 3], atol=1e-5)
    studio.stage_of.value = "refined"


def test_filters_keep_what_they_say(studio: Studio, made: module.ShownGrasps) -> None:
    half = made.refined.replace(success=torch.arange(6) % 2 == 0)
    assert chosen(made.hand, half, "succeeded", "any").tolist() == [True, False] * 3
    assert chosen(made.hand, half, "failed", "any").tolist() == [False, True] * 3
    palms = made.hand.palm_directions(half.T_object_wrist)
    counts = 0
    for axis in HALF_AXES:
        keep = chosen(made.hand, half, "all", axis)
        counts += int(keep.sum())
        assert bool((palms[keep] @ torch.tensor(half_axis_direction(axis)) > 0.57).all())
    assert counts == 6
    studio.success.value, studio.palm.value = next(
        (outcome, axis) for outcome in ("succeeded", "failed") for axis in HALF_AXES
        if not chosen(made.hand, made.refined, outcome, axis).any())
    studio._filter()
    assert studio.text.content == "No grasp passes these filters."
    assert studio.play.disabled
    studio.success.value, studio.palm.value = "all", "any"
    studio._filter()


def test_contacts_are_marked_where_the_hand_touches_and_only_when_asked(studio: Studio, made: module.ShownGrasps) -> None:
    assert not studio.view.contacts.visible
    studio.contacts.value = True
    try:
        points = torch.as_tensor(np.asarray(studio.view.contacts.points)).float()
        if len(points):
            assert float(made.obj.distance_field.distances(points)[0].abs().max()) < 0.003
        assert studio.view.contacts.visible
    finally:
        studio.contacts.value = False
    assert not studio.view.contacts.visible


def test_a_trial_plays_and_ends_where_it_began(
    studio: Studio, made: module.ShownGrasps, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    honest = studio.view.show

    def show(joints, T, T_object=None):
        seen.append(T_object)
        honest(joints, T, T_object)

    monkeypatch.setattr(studio.view, "show", show)
    use(studio.play)
    assert (studio.moment.max, studio.moment.disabled) == (len(seen) - 1, False)
    studio.show_moment(7)
    assert torch.equal(seen.pop(), seen[7]), "any moment can be seen again"
    moved = [T for T in seen if T is not None]
    assert len(moved) > 50
    assert float((moved[0] - torch.eye(4)).abs().max()) < 1e-4, "the object starts where it was"
    studio._show()
    assert seen[-1] is None
    assert studio.moment.disabled, "another picture has no moments"


def test_a_filter_that_no_grasp_passes_ends_a_trial_that_plays(
    studio: Studio, made: module.ShownGrasps, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses = torch.eye(4).repeat(5, 1, 1)
    monkeypatch.setattr(module, "record", lambda *_: (poses, made.refined.joints[:1].expand(5, -1)))
    monkeypatch.setattr(module, "chosen", lambda *_: torch.zeros(6, dtype=torch.bool))
    waits: list[float] = []

    def wait(seconds: float) -> None:
        waits.append(seconds)
        if len(waits) == 2:
            studio._filter()

    monkeypatch.setattr(time, "sleep", wait)
    try:
        studio._guarded(studio._play)
        assert (len(waits), studio.moment.disabled, studio.moment.value) == (2, True, 0)
        assert studio.text.content == "No grasp passes these filters."
        assert "something else was picked" in studio.status.content
        studio.show_moment(1)
        studio._guarded(studio._play)
        assert len(waits) == 2, "nothing is left to play"
    finally:
        monkeypatch.undo()
        studio._filter()


@pytest.mark.parametrize("kind", EXPORTS)
def test_what_is_taken_away_is_what_is_shown(made: module.ShownGrasps, kind: str, tmp_path: Path) -> None:
    name, content = exported(made.hand, made.obj, made.refined, kind)
    assert name.startswith("gripper3_sphere")
    if name.endswith(".parquet"):
        assert torch.equal(GraspBatch.load(io.BytesIO(content)).joints, made.refined.joints)
    elif name.endswith(".csv"):
        assert len([x for x in content.decode().splitlines() if not x.startswith("#")]) == 7
    elif name.endswith(".usd"):
        (tmp_path / name).write_bytes(content)
        stage = pytest.importorskip("pxr.Usd").Stage.Open(str(tmp_path / name))
        assert len(stage.GetPrimAtPath("/World/grasps").GetChildren()) == 6
    else:
        read = yaml.safe_load(content)
        assert len(read["grasps"] if isinstance(read, dict) else read) == 6


@pytest.mark.parametrize("kind", [title for title in EXPORTS if title != module.GRASP_FILE])
def test_grasps_that_state_no_pregrasp_are_taken_away_with_the_one_that_is_shown(
    made: module.ShownGrasps, kind: str
) -> None:
    unknown = torch.full_like(made.refined.joints, float("nan"))
    bare = made.refined.replace(pregrasp_joints=unknown, squeeze_joints=unknown)
    shown = postures_of(made.hand, made.obj, bare)
    stated = made.refined.replace(pregrasp_joints=shown["pregrasp"], squeeze_joints=shown["squeeze"])
    assert exported(made.hand, made.obj, bare, kind) == exported(made.hand, made.obj, stated, kind)


def test_uploads_are_picked_and_errors_are_shown(studio: Studio) -> None:
    text = (BUILTIN_FOLDER / "gripper3.urdf").read_bytes()
    studio._take(viser.UploadedFile(name="../mine.urdf", content=text), "hand", studio.hand, studio._preview)
    assert studio.hand.value == "mine.urdf", "no path of a temporary folder"
    assert studio.view.hand is not None
    assert studio.view.hand.name == "mine", "the uploaded hand is shown at once"
    studio._take(viser.UploadedFile(name="bad.urdf", content=b"<robot"), "hand", studio.hand, studio._preview)
    assert studio.status.content.startswith("**Error:**")
    assert "bad.urdf" in studio.status.content
    assert "/" not in studio.status.content.split("bad.urdf")[0], "no path of a temporary folder"
    studio.hand.value = "gripper3"


def test_an_upload_waits_for_other_work_and_is_never_lost(studio: Studio) -> None:
    text = (BUILTIN_FOLDER / "gripper3.urdf").read_bytes()

    def upload(name: str, patience: float = 10.0) -> threading.Thread:
        file = viser.UploadedFile(name=name, content=text)
        thread = threading.Thread(target=lambda: studio._take(file, "hand", studio.hand, studio._preview, patience))
        thread.start()
        return thread

    with studio._busy:
        waiting = upload("early.urdf")
        time.sleep(0.2)
        assert waiting.is_alive()
        assert studio.hand.value == "gripper3"
    waiting.join(20)
    assert studio.hand.value == "early.urdf"
    assert "early.urdf is picked" in studio.status.content
    studio.hand.value = "gripper3"
    with studio._busy:
        upload("late.urdf", 0.1).join(20)
    assert studio.hand.value == "gripper3"
    assert "late.urdf" in studio.hand.options
    assert "late.urdf is stored; pick it" in studio.status.content


def test_what_is_picked_while_the_page_is_busy_is_shown_afterwards(studio: Studio) -> None:
    begun, go_on = threading.Event(), threading.Event()
    work = threading.Thread(target=lambda: studio._guarded(lambda: (begun.set(), go_on.wait(20))))
    work.start()
    assert begun.wait(20)
    try:
        for _ in range(2):
            use(studio.object, "can")
        use(studio.panel.table, "-0.05")
        assert "Busy" in studio.status.content
    finally:
        go_on.set()
    work.join(60)
    assert studio.client.scene.get_handle_by_name("/constraints/table") is not None
    use(studio.panel.table, "here")
    assert "is 'here', which holds something else" in studio.status.content
    studio.panel.table.value = ""
    use(studio.object, "sphere")
    assert "gripper3 above sphere" in studio.status.content


def test_a_fault_is_told_as_well_as_raised(studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    def faulty(*_: object) -> None:
        studio._say("Generating ...")
        raise ZeroDivisionError("an error of ours")

    monkeypatch.setattr(studio.predictor, "run", faulty)
    with pytest.raises(ZeroDivisionError):
        use(studio.button)
    assert "**Error:** ZeroDivisionError: an error of ours; this is a fault of dro-grasp" in studio.status.content
    monkeypatch.undo()
    use(studio.object, "sphere")
    assert "Error" not in studio.status.content
    monkeypatch.setattr(studio.library, "take", faulty)
    with pytest.raises(ZeroDivisionError):
        studio._take(viser.UploadedFile(name="a.urdf", content=b""), "hand", studio.hand, studio._preview)
    assert "an error of ours" in studio.status.content


def test_no_control_is_sent_before_all_are_connected(studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    """A browser must not be able to upload a file that nothing takes."""
    within: list[str] = []
    honest = studio.client.atomic

    @contextmanager
    def atomic():
        with honest():
            within.append("held back")
            yield
            within.append("sent")

    class Watched(Studio):
        def _add_display(self) -> None:
            within.append("last controls")
            super()._add_display()

    monkeypatch.setattr(studio.client, "atomic", atomic)
    Watched(studio.client, studio.predictor, "gripper3", "sphere", preview=False).close()
    assert within[:3] == ["held back", "last controls", "sent"]


def test_the_page_starts_with_the_hand_and_the_mesh_that_the_command_names(tmp_path: Path) -> None:
    (tmp_path / "my claw.urdf").write_bytes((BUILTIN_FOLDER / "gripper3.urdf").read_bytes())
    trimesh.creation.icosphere(radius=30.0).export(tmp_path / "my egg.stl")
    named = View(hand=str(tmp_path / "my claw.urdf"), object=str(tmp_path / "my egg.stl"), scale=0.001,
                 weights=str(untrained_weights(tmp_path)))
    served = ServedPage(free_port(), HOST)
    studio = named._picked()(served.server, threading.Lock())
    try:
        assert (studio.hand.value, studio.object.value) == ("my claw", "my egg")
        assert "my claw above my egg" in studio.status.content
        assert float(np.ptp(studio.library.obj("my egg").cloud, axis=0).max()) == pytest.approx(0.06, abs=1e-3)
        assert studio.object.options[0] == "my egg"
        assert set(BUILTIN) <= set(studio.object.options)
    finally:
        studio.close()
        served.stop()
    with pytest.raises(HandError, match="nowhere"):
        View(hand="nowhere.urdf")._picked()


def test_one_thing_at_a_time(studio: Studio) -> None:
    with studio._busy:
        studio._guarded(lambda: pytest.fail("done beside other work"))
    assert "Busy" in studio.status.content


def test_every_browser_has_a_page_and_closing_it_ends_its_work_and_its_uploads(
    studio: Studio
) -> None:
    """Two browsers come, one leaves while it works, the other stays as it was."""
    made: list[Studio] = []
    begun, steps = threading.Event(), []

    class Endless(GraspPredictor):
        def __init__(self) -> None:
            self.device, self.network = "cpu", studio.predictor.network

        def run(self, problem, request, progress=None):
            begun.set()
            for step in range(1000):
                steps.append(step)
                progress(step, 1000)
                time.sleep(0.01)

    def make(client, turn):
        made.append(Studio(client, Endless(), "gripper3", "sphere", turn))
        return made[-1]

    served = StudioServer(make, free_port())
    try:
        clients = visited(served, 2)
        text = (BUILTIN_FOLDER / "gripper3.urdf").read_bytes()
        for page, name in zip(made, ("mine.urdf", "theirs.urdf"), strict=True):
            page._take(viser.UploadedFile(name=name, content=text), "hand", page.hand, page._preview)
        assert "mine.urdf" not in made[1].hand.options
        assert "theirs.urdf" not in made[0].hand.options
        folders = [Path(page.library.folder.name) for page in made]
        work = threading.Thread(target=lambda: made[0]._guarded(made[0]._generate))
        work.start()
        assert begun.wait(20)
        served.leave(clients[0])
        work.join(20)
        assert not work.is_alive()
        assert len(steps) < 1000, "it ended at the next step"
        assert [folder.exists() for folder in folders] == [False, True]
        assert made[0]._turn.acquire(blocking=False), "the others may compute"
    finally:
        served.stop()
    assert not any(folder.exists() for folder in folders)


def test_what_a_file_states_is_shown_as_text_and_never_as_html(studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    """viser's browser shows raw HTML in Markdown."""
    attack = "<img src=x onerror=alert(1)>{alert(1)}[a](javascript:alert(1))**b**"
    hand, obj = replace(studio.library.hand("gripper3"), name=f"hand{attack}"), load_object("sphere")
    T = torch.eye(4)[None]
    T[0, :3, 3] = -hand.grasp_centre_wrist
    grasps = GraspBatch.create(
        hand, obj, T, hand.canonical_joints(0.6)[None], success=torch.tensor([False]), protocol=(attack,)).replace(
        object=(attack,), extra={REASON: [attack], CONTACT_LINKS: [[attack]]})
    shown: list[str] = []
    titles: list[str] = []
    add_markdown = viser.GuiApi.add_markdown
    monkeypatch.setattr(viser.GuiApi, "add_markdown", lambda gui, text: titles.append(text) or add_markdown(gui, text))
    page = Studio(studio.client, studio.predictor, "gripper3", "sphere", preview=False)
    try:
        page.open(hand, grasps, replace(obj, name=attack))
        shown += [page.status.content, page.text.content]
        page.offer(hand, None)
        shown.append(page.status.content)
        page._complain(HandError(attack))
        shown.append(page.status.content)
        upload = viser.UploadedFile(name=f"{attack}.urdf", content=b"<robot")
        page._take(upload, "hand", page.hand, page._preview)
        shown.append(page.status.content)
    finally:
        page.close()
    viewer = GraspViewer(hand, replace(obj, name=attack), grasps, port=free_port())
    viewer.stop()
    texts = [*shown, *titles, viewer.status.content, viewer.text.content]
    assert sum("onerror" in text for text in texts) == 7
    for text in filter(None, texts):
        assert not set("<{[`") & set(text), text
        assert "**b" not in text
        assert "b**" not in text


@pytest.mark.slow
def test_a_browser_runs_nothing_that_a_grasp_file_states(tmp_path: Path) -> None:
    """An image with `onerror`, and a frame, wherever a file has text that the page shows."""
    attack = "<img src=nowhere onerror=\"window.hit=1\"><iframe srcdoc=\"<script>parent.hit=1</script>\"></iframe>"
    hand, obj = load_hand("gripper3"), load_object("sphere")
    T = torch.eye(4)[None]
    T[0, :3, 3] = -hand.grasp_centre_wrist
    GraspBatch.create(
        hand, obj, T, hand.canonical_joints(0.6)[None], success=torch.tensor([False]), protocol=("strict/1",)).replace(
        hand=attack, hand_sha256="a" * 64, object=(attack,), object_sha256=("b" * 64,),
        extra={REASON: [attack], CONTACT_LINKS: [[attack]]}).save(tmp_path / "g.parquet")
    with page_of(str(tmp_path / "g.parquet"), "--hand", "gripper3", "--object", "sphere", size=(1280, 860)) as page:
        page.get_by_text("touched by").first.wait_for(timeout=120_000)
        time.sleep(2)
        assert page.evaluate("window.hit") is None
        assert page.locator("iframe").count() == page.locator("img[src=nowhere]").count() == 0
        assert "onerror=" in page.locator("body").inner_text()


CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, 1.0), "fov": 0.8, "near": 0.01,
    "far": 100.0, "image_height": 600, "image_width": 800, "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0)}
"""What a browser says first: with it, viser takes it for one."""


async def visit(port: int, entered: threading.Event) -> None:
    """Open the page as a browser does, and leave when it is there."""
    protocol, origin = websockets.Subprotocol(f"viser-v{viser.__version__}"), websockets.Origin(f"http://{HOST}:{port}")
    async with websockets.connect(f"ws://{HOST}:{port}", subprotocols=[protocol], origin=origin, max_size=None) as opened:
        await opened.send(msgspec.msgpack.encode(CAMERA))
        await asyncio.to_thread(entered.wait, 60)


def test_pages_that_were_closed_leave_nothing_in_memory(studio: Studio) -> None:
    """Pages refer to themselves, and Python looks for such waste rarely where much is loaded."""
    entered, pages = threading.Event(), []

    def make(client, turn):
        made = Studio(client, studio.predictor, "gripper3", "sphere", turn, preview=False)
        pages.append(weakref.ref(made))
        entered.set()
        return made

    def left() -> int:
        return sum(page() is not None for page in pages)

    served = StudioServer(make, free_port(), HOST)
    gc.disable()
    try:
        while len(pages) < 4 or (left() > 1 and len(pages) < 12):  # a page that was drawn as it closed goes with the next
            entered.clear()
            asyncio.run(visit(served.server.get_port(), entered))
            end = time.monotonic() + 60
            while served.studios and time.monotonic() < end:
                time.sleep(0.05)
        assert left() <= 1, f"{left()} of {len(pages)} closed pages are in memory; the last one may be on its way"
    finally:
        gc.enable()
        served.stop()


@pytest.mark.slow
def test_a_browser_goes_all_the_way(tmp_path: Path) -> None:
    mesh, urdf = tmp_path / "block.stl", tmp_path / "mine.urdf"
    urdf.write_bytes((BUILTIN_FOLDER / "gripper3.urdf").read_bytes())
    import trimesh

    box = load_object("sphere")
    trimesh.Trimesh(box.vertices, box.faces).export(mesh)
    with page_of(size=(1280, 860)) as page:
        inputs = page.locator("input[type=file]")
        inputs.nth(0).set_input_files(urdf)
        page.get_by_text("mine.urdf is picked").wait_for(timeout=60_000)
        inputs.nth(1).set_input_files(mesh)
        page.get_by_text("block.stl is picked").wait_for(timeout=60_000)
        page.get_by_role("button", name="Generate", exact=True).click(timeout=60_000)
        page.get_by_text("held under").wait_for(timeout=180_000)
        page.get_by_role("button", name="network", exact=True).click(timeout=60_000)
        page.get_by_role("button", name="refined", exact=True).click(timeout=60_000)
        page.get_by_role("button", name="Play the trial").click(timeout=60_000)
        page.get_by_text("Played.").wait_for(timeout=180_000)
        time.sleep(1)
        with page.expect_download(timeout=60_000) as download:
            page.get_by_role("button", name="Download the shown grasps").click()
        saved = tmp_path / "taken.parquet"
        download.value.save_as(saved)
        time.sleep(3)
        page.screenshot(path=tmp_path / "page.png", timeout=300_000)
    assert len(GraspBatch.load(saved)) == 16
    assert (tmp_path / "page.png").stat().st_size > 20_000


def test_sigterm_removes_what_was_uploaded(tmp_path: Path) -> None:
    code = ("import sys; from dro_grasp.apps.library import Library; from dro_grasp.apps.viewer.scene_view import serve\n"
            "from types import SimpleNamespace; import signal, time\n"
            "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored where tests run in the background
            "signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"  # and that under nohup
            "library = Library(); library.take('a.stl', b'solid', 'object')\n"
            "server = SimpleNamespace(sleep_forever=lambda: time.sleep(60))\n"
            "serve(SimpleNamespace(url='here', server=server, stop=library.close))\n")
    for sign in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True,
                              env={**os.environ, "TMPDIR": str(tmp_path)}) as process:
            assert process.stderr is not None
            assert "viewer: here" in process.stderr.readline()
            assert list(tmp_path.glob("dro-grasp-*/1/a.stl"))
            time.sleep(0.3)
            process.send_signal(sign)
            assert process.wait(20) == 0
            assert process.stderr.read() == ""
        assert list(tmp_path.iterdir()) == []


def test_a_name_that_no_list_offers_is_no_path(studio: Studio, tmp_path: Path) -> None:
    file = tmp_path / "secret.stl"
    trimesh.creation.box([0.05] * 3).export(file)
    for kind in ("hand", "object", "scene"):
        with pytest.raises(OptionError, match=f"no {kind} is called '{file}' here"):
            studio.library._of_name(kind, str(file), lambda name: pytest.fail(f"{name} is read"))
