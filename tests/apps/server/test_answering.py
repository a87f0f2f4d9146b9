"""What a grasp server answers, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

import dro_grasp as dro
from dro_grasp.errors import ObjectError, OptionError
from dro_grasp.hands.effort import find_efforts
from dro_grasp.predict import stages
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.problem import GraspProblem
from tests.helpers.claw_urdf import claw, written
from tests.helpers.made_scenes import make_scene
from tests.helpers.weights import untrained_weights

pytest.importorskip("pydantic", reason="needs the extra [apps]: pip install '.[apps]'")

from dro_grasp.apps.server.answering import Answerer, ServerConfig, sent_grasps
from dro_grasp.apps.server.client import sent_file, sent_mask
from dro_grasp.apps.server.messages import GenerateCall, GraspAnswer, GraspCall
from dro_grasp.apps.server.request_queue import Cancelled

QUICK: dict[str, Any] = {"source": "network", "candidates": 1, "refine": False}
TUBE = trimesh.creation.cylinder(0.03, 0.1)


@pytest.fixture(scope="module")
def answerer(weights: str, tmp_path_factory: pytest.TempPathFactory) -> Answerer:
    own = tmp_path_factory.mktemp("own") / "own_tube.stl"
    TUBE.export(own)
    return Answerer(ServerConfig(weights, hands=("gripper3",), objects=(str(own),)))


def ask(answerer: Answerer, obj: Any, **options: Any) -> GraspAnswer:
    return answerer.answer(GraspCall(hand="gripper3", object=obj, **QUICK | options))


def check(answer: GraspAnswer, expected: dro.GraspBatch) -> None:
    for name in ("wrist_position", "wrist_quaternion_wxyz", "joints", "pregrasp_joints", "squeeze_joints", "score"):
        found = torch.tensor([getattr(grasp, name) for grasp in answer.grasps])
        torch.testing.assert_close(found, getattr(expected, name))
    assert answer.joint_names == list(expected.joint_names)


def test_answers_are_the_predictors_grasps(answerer: Answerer) -> None:
    hand, predictor = dro.load_hand("gripper3"), answerer.predictor
    above = ask(answerer, "can", num=2, seed=3, direction=(0, 0, -1), protocol="dro")
    check(above, predictor.predict(hand, dro.load_object("can"), 2, 3, direction=(0.0, 0.0, -1.0), **QUICK))
    assert above.frame == "object"
    assert all(isinstance(grasp.success, bool) for grasp in above.grasps)
    seen = TUBE.sample(300, seed=0) + np.array([0, 0, 0.5])
    T = trimesh.transformations.rotation_matrix(2.5, [1, 0, 0], [0.3, 0.2, 0.8])
    scan = ask(answerer, {"points": seen.tolist()}, num=1, camera={"frame": "base", "T_frame_camera": T.tolist()})
    check(scan, predictor.predict(hand, dro.scanned_object("cloud", seen, T), 1, **QUICK))
    assert scan.frame == "base"
    assert scan.grasps[0].success is None


def test_what_a_camera_saw_ends_on_the_table_that_is_asked_for(answerer: Answerer) -> None:
    seen = TUBE.sample(2000, seed=0) + np.array([0, 0, 0.5])
    seen = seen[seen[:, 2] < 0.5]  # the front, seen from beside the tube
    T = trimesh.transformations.rotation_matrix(2.5, [1, 0, 0], [0.3, 0.2, 0.8])
    height = float((seen @ T[:3, :3].T + T[:3, 3])[:, 2].min()) - 0.01
    camera = {"frame": "base", "T_frame_camera": T.tolist()}

    def asked(**table: float) -> dro.ObjectModel:
        return answerer.problem(GraspCall(hand="gripper3", object={"points": seen.tolist()}, camera=camera, **table)).obj

    plane = [*T[2, :3], float(np.float32(height)) - T[2, 3]]
    assert asked(table=height).sha256 == dro.scanned_object("cloud", seen, T, table=plane).sha256
    assert asked().sha256 == dro.scanned_object("cloud", seen, T).sha256 != asked(table=height).sha256


def test_answers_carry_forces(answerer: Answerer) -> None:
    """Efforts no larger than the hand's, and null where something is unknown."""
    hand, obj = dro.load_hand("gripper3"), dro.load_object("can")
    made = answerer.predictor.run(GraspProblem(hand, obj), GraspRequest(2, 3, source="network", candidates=1, refine=False))
    limit = find_efforts(hand).limit
    torque = torch.stack([-3 * limit, torch.full_like(limit, torch.nan)])
    payload, force = torch.tensor([0.8, torch.nan]), torch.tensor([torch.nan, 6.25])
    grasps = made.grasps.replace(squeeze_torque=torque, payload=payload, squeeze_force=force)
    first, second = (json.loads(grasp.model_dump_json()) for grasp in sent_grasps(hand, grasps, made))
    np.testing.assert_allclose(first["squeeze_torque"], -limit)
    assert (first["payload"], first["squeeze_force"]) == (pytest.approx(0.8), None)
    assert (second["squeeze_torque"], second["payload"], second["squeeze_force"]) == (None, None, 6.25)


def test_the_objects_mass_is_the_one_that_is_sent(answerer: Answerer, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a mesh and of a cloud, in prediction and in trial, and not in what is asked for next."""
    seen: list[float] = []
    predict, trial = answerer.predictor.run, stages.simulate

    def run(problem: GraspProblem, *rest: Any) -> Any:
        seen.append(problem.mass)
        return predict(problem, *rest)

    def simulate(hand: dro.Hand, obj: dro.ObjectModel, *rest: Any, **options: Any) -> Any:
        seen.append(obj.mass)
        return trial(hand, obj, *rest, **options)

    monkeypatch.setattr(answerer.predictor, "run", run)
    monkeypatch.setattr(stages, "simulate", simulate)
    usual, cloud = dro.load_object("can").mass, {"points": SPHERE}
    for mass in (0.7, 0.2, None):
        ask(answerer, "can", num=1, mass=mass, protocol="dro")
    ask(answerer, cloud, num=1, mass=0.3)
    assert seen == pytest.approx([0.7, 0.7, 0.2, 0.2, usual, usual, 0.3])
    with pytest.raises(ValueError, match=r"mass\n.* valid number"):
        GraspCall(hand="gripper3", object="can", mass="heavy")


def test_a_scene_is_avoided_in_the_frame_of_the_grasps(answerer: Answerer) -> None:
    wall, T = np.array([[0.06, y, z] for y in np.linspace(-0.2, 0.2, 40) for z in np.linspace(-0.2, 0.2, 40)]), np.eye(4)
    T[0, 3] = 0.01
    for camera, points in ((None, wall), ({"frame": "base", "T_frame_camera": T.tolist()}, wall - T[:3, 3])):
        call = GraspCall(hand="gripper3", object="can", obstacles={"points": points.tolist()}, camera=camera)
        scene = answerer.scene(call.obstacles, call.camera)
        expected = dro.load_scene(points).moved(np.eye(4) if camera is None else T)
        np.testing.assert_allclose(scene.points, expected.points)
        assert answerer.scene(call.obstacles, call.camera) is scene
    assert answerer.scene(None, None) is None
    asked = ask(answerer, "can", num=1, candidates=16, obstacles={"points": wall.tolist()}, contact_region=[[0, 0, 0, 0.3]])
    avoiding = dro.Constraints(obstacles=dro.load_scene(wall), contact_region=((0.0, 0.0, 0.0, 0.3),))
    hand, can = dro.load_hand("gripper3"), dro.load_object("can")
    options = QUICK | {"candidates": 16}
    check(asked, answerer.predictor.predict(hand, can, 1, constraints=avoiding, **options))


def test_what_was_sent_or_named_once_stays_loaded(answerer: Answerer) -> None:
    stl = TUBE.export(file_type="stl")
    first = answerer.object(GraspCall(hand="", object=sent_file("tube.stl", stl)).object, None)
    again = answerer.object(GraspCall(hand="", object=sent_file("tube.stl", stl)).object, None)
    assert first[1] is again[1]
    assert first[1].name == "tube"
    assert first[1].file is None
    for other in (sent_file("tube.stl", stl) | {"scale": 1.5}, sent_file("other.stl", stl), "own_tube"):
        assert answerer.object(GraspCall(hand="", object=other).object, None)[1] is not first[1]
    assert answerer.hand("gripper3") is answerer.hand("gripper3")
    assert answerer.hand("barrett") is answerer.hand("barrett")
    assert "own_tube" in answerer.object_names()


def test_hands_and_objects_that_could_not_be_told_apart_are_refused(tmp_path: Path) -> None:
    weights = str(untrained_weights(tmp_path))
    for folder in ("003", "004"):
        (tmp_path / folder).mkdir()
        TUBE.export(tmp_path / folder / "textured.stl")
        written(tmp_path / folder, claw())
    first, second = (str(tmp_path / folder / "textured.stl") for folder in ("003", "004"))
    with pytest.raises(OptionError, match=f"objects '{first}' and '{second}' .* by the name 'textured'; rename one"):
        Answerer(ServerConfig(weights, objects=(first, second)))
    with pytest.raises(OptionError, match=r"hands '.*003/claw.urdf' and '.*004/claw.urdf' .* by the name 'claw'; rename one"):
        Answerer(ServerConfig(weights, hands=tuple(str(tmp_path / folder / "claw.urdf") for folder in ("003", "004"))))
    once = Answerer(ServerConfig(weights, hands=("gripper3", "gripper3"), objects=(first, str(tmp_path / "003"))))
    assert [list(once.library.own[kind]) for kind in ("hand", "object")] == [["gripper3"], ["textured"]]


GLTF = b'{"asset": {"version": "2.0"}, "buffers": [{"uri": "/etc/passwd", "byteLength": 9}]}'
SPHERE = trimesh.creation.icosphere(1, 0.03).vertices.tolist()
AHEAD = [[x, y, z + 0.5] for x, y, z in SPHERE]
CAMERA = {"frame": "base", "T_frame_camera": np.eye(4).tolist()}


@pytest.mark.parametrize(("asked", "told"), [
    ({"hand": "/etc/passwd"}, "knows no hand '/etc/passwd'"), ({"object": "/etc/passwd"}, "knows no object '/etc/passwd'"),
    ({"object": sent_file("../../gone.stl", b"hello")}, "^gone.stl "),
    ({"object": sent_file("a.gltf", GLTF)}, "^a.gltf .*passwd"),
    ({"num": 0}, "num is 0"), ({"direction": [0, 0, 0]}, "no direction"), ({"seed": -1}, "seed is -1"),
    ({"mass": 0.0}, "mass is 0.0; give kilograms, above 0"), ({"mass": 400.0}, "400 g are 0.4 kg"),
    ({"mass": float("nan")}, "mass is nan"), ({"num": 1001}, "at most 1000"),
    ({"object": {"points": [[0, 0, 0.1]] * 40}}, "1 distinct points"),
    ({"object": {"points": SPHERE}, "protocol": "dro"}, "no trial"), ({"object": {"points": []}}, "distinct points"),
    ({"obstacles": "/etc/passwd"}, "obstacles names '/etc/passwd'"), ({"obstacles": {"points": []}}, "holds no point"),
    ({"camera": CAMERA}, "send the cloud"),
    ({"camera": {"frame": "base", "T_frame_camera": np.zeros((4, 4)).tolist()}, "object": {"points": SPHERE}}, "last row"),
    ({"camera": {"frame": "a\nb", "T_frame_camera": np.eye(4).tolist()}, "object": {"points": SPHERE}}, "a name on one line"),
    *(({"camera": CAMERA, "object": {"points": AHEAD, "scale": scale}}, f"scale is {scale}") for scale in (-1.0, 0.0)),
])
def test_refusals_say_why_and_nothing_but_what_was_sent_is_read(answerer: Answerer, asked: dict[str, Any], told: str) -> None:
    with pytest.raises(dro.DroGraspError, match=told):
        answerer.answer(GraspCall(**{"hand": "gripper3", "object": "can", **QUICK, **asked}))


@pytest.mark.parametrize("kind", [GraspCall, GenerateCall])
def test_an_unknown_protocol_is_refused_before_the_work(
    answerer: Answerer, kind: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(answerer.predictor, "run", lambda *_: pytest.fail("grasps are made"))
    with pytest.raises(dro.DroGraspError, match="no protocol is called 'drop'"):
        answerer.answer(kind(hand="gripper3", object="can", protocol="drop"))


@pytest.mark.parametrize("kind", [GraspCall, GenerateCall])
def test_a_request_can_be_cancelled_while_its_object_is_cut(
    answerer: Answerer, kind: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cancelled(done: int, total: int) -> None:
        if total == 7777:
            raise Cancelled

    def cut(vertices: Any, faces: Any, sha256: str, progress: Any = None) -> Any:
        assert progress is not None, "it would be cut unheard"
        progress(0, 7777)

    monkeypatch.setattr("dro_grasp.objects.shape.decompose", cut)
    stl = trimesh.creation.torus(0.031, 0.012).export(file_type="stl")
    with pytest.raises(Cancelled):
        answerer.answer(kind(hand="gripper3", object=sent_file("ring.stl", stl)), cancelled)


def test_one_thing_of_a_scene_is_chosen_and_all_else_is_avoided(answerer: Answerer, tmp_path: Path) -> None:
    made = make_scene("table", 4, 15, 1, width=320)
    np.save(tmp_path / "depth.npy", made.depth)
    sent = {"file": sent_file("depth.npy", (tmp_path / "depth.npy").read_bytes())["file"]}
    camera = {"frame": "world", "T_frame_camera": made.camera.T_frame_camera.tolist(),
              "intrinsics": np.asarray(made.camera.intrinsics).tolist()}
    middle = made.middles[1].tolist()
    call = GraspCall(hand="gripper3", object=sent, camera=camera, choose={"at": middle}, **QUICK)
    found = answerer.chosen(call)
    assert np.linalg.norm((found.obj.cloud.min(0) + found.obj.cloud.max(0)) / 2 - made.middles[1]) < 0.02
    assert found.obstacles is not None
    for k in (0, 2, 3):  # the others are avoided
        assert np.linalg.norm(found.obstacles.points - made.middles[k], axis=1).min() < 0.05
    with pytest.raises(ObjectError, match="shows 4 things"):
        ask(answerer, sent, camera=camera, choose={})
    with pytest.raises(OptionError, match=r"choose is given, and keep_table keeps a table .* leave keep_table out"):
        ask(answerer, sent | {"keep_table": True}, camera=camera, choose={"at": middle})
    by_mask = answerer.chosen(GraspCall(
        hand="gripper3", object=sent, camera=camera, choose={"mask": sent_mask(made.owner == 1)}, **QUICK))
    np.testing.assert_array_less(abs(by_mask.obj.extents - found.obj.extents), 0.01)
    with pytest.raises(ObjectError, match=r"mask\.png"):
        ask(answerer, sent, camera=camera, choose={"mask": sent_mask(made.owner == 1) | {"content": "aGFsbG8="}})
    wall = {"points": [[9.0, 0.0, 0.0]]}  # in the camera's frame, as the scene
    problem = answerer.problem(GraspCall(
        hand="gripper3", object=sent, camera=camera, choose={"at": middle}, obstacles=wall, **QUICK))
    assert problem.constraints.obstacles is not None
    seen, given = problem.constraints.obstacles.parts
    assert len(seen.points) == len(found.obstacles.points)
    np.testing.assert_allclose(given.points[0], made.camera.T_frame_camera[:3] @ (9.0, 0.0, 0.0, 1.0), atol=1e-6)
    answer = ask(answerer, sent, camera=camera, choose={"at": middle}, num=1, candidates=4, least_confidence=0)
    assert answer.frame == "world"
