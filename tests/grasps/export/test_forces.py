"""Forces in exported files: what MuJoCo says of the joints, read back as each format's own reader does."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import yaml
from scipy.spatial.transform import Rotation

import dro_grasp as dro
from dro_grasp.cli.main import main
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import pregrasp_and_squeeze
from dro_grasp.grasps.export.formats import FORMATS, ExportJob
from dro_grasp.grasps.export.writers import Frame
from dro_grasp.grasps.forces import forces_in_words, forces_of_all, squeeze_efforts
from dro_grasp.hands.effort import find_efforts
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.settling import SettleConfig
from dro_grasp.simulation.rollout import Rollout, rollouts
from dro_grasp.simulation.scene import PREFIX, TrialScene, scene_of
from tests.helpers.claw_urdf import claw, joint, written
from tests.helpers.loaded_hands import loaded_hand

COUPLED = ("barrett", "shadowhand")  # built-in hands some of whose joints follow others
HEADER = {"stamp": {"sec": int, "nanosec": int}, "frame_id": str}
POINT = {"positions": [float], "velocities": [float], "accelerations": [float], "effort": [float],
         "time_from_start": {"sec": int, "nanosec": int}}
JOINT_TRAJECTORY = {"header": HEADER, "joint_names": [str], "points": [POINT]}
XYZ = {"x": float, "y": float, "z": float}
TRANSLATION = {"direction": {"header": HEADER, "vector": XYZ}, "desired_distance": float, "min_distance": float}
GRASP = {
    "id": str, "pre_grasp_posture": JOINT_TRAJECTORY, "grasp_posture": JOINT_TRAJECTORY,
    "grasp_pose": {"header": HEADER, "pose": {"position": XYZ, "orientation": XYZ | {"w": float}}}, "grasp_quality": float,
    "pre_grasp_approach": TRANSLATION, "post_grasp_retreat": TRANSLATION, "post_place_retreat": TRANSLATION,
    "max_contact_force": float, "allowed_touch_objects": [str]}
"""Fields of moveit_msgs/Grasp and of the messages in it, as their definitions in ROS 2 have them."""


def filled(message: Any, layout: Any) -> None:
    """What ROS does with a message from YAML: fields that it does not have are refused, values of another type too."""
    if isinstance(layout, dict):
        assert isinstance(message, dict)
        assert message.keys() <= layout.keys()
        for name, value in message.items():
            filled(value, layout[name])
    elif isinstance(layout, list):
        assert isinstance(message, list)
        for value in message:
            filled(value, layout[0])
    else:
        assert type(message) is layout
        assert layout is not float or math.isfinite(message)


def imported(text: str) -> dict[str, dict[str, Any]]:
    """The grasps of an isaac_grasp file as Isaac Sim's importer hands them out: what it needs, and whatever else."""
    content = yaml.safe_load(text)
    assert (content["format"], content["format_version"]) == ("isaac_grasp", 1.0)
    for grasp in content["grasps"].values():
        assert 0 <= grasp["confidence"] <= 1
        assert len(grasp["position"]) == len(grasp["orientation"]["xyz"]) == 3
        assert grasp["cspace_position"].keys() == grasp["pregrasp_cspace_position"].keys()
    return content["grasps"]


def posed(hand: Hand, n: int) -> GraspBatch:
    generator, can = torch.Generator().manual_seed(0), load_object("can")
    T = torch.eye(4).repeat(n, 1, 1)
    T[:, :3, :3] = torch.from_numpy(Rotation.random(n, random_state=1).as_matrix())
    joints = hand.random_joints(n, generator)
    pregrasp, squeeze = pregrasp_and_squeeze(hand, T, joints, torch.zeros(3))
    return GraspBatch.create(hand, can, T, joints, pregrasp_joints=pregrasp, squeeze_joints=squeeze)


@pytest.fixture(params=COUPLED)
def hand(request: pytest.FixtureRequest) -> Hand:
    return loaded_hand(request.param)


@pytest.fixture
def grasps(hand: Hand) -> GraspBatch:
    """Forces of the first are within what the hand exerts, of the second beyond, of the third unknown."""
    limit, sign = find_efforts(hand).limit, torch.where(torch.arange(hand.tree.n_dof) % 2 == 0, 1.0, -1.0)
    torque = torch.stack([0.5 * limit * sign, 10 * limit * sign, torch.full_like(limit, torch.nan)])
    payload, force = torch.tensor([0.8, 12.0, torch.nan]), torch.tensor([6.25, 31.0, torch.nan])
    return posed(hand, 3).replace(squeeze_torque=torque, payload=payload, squeeze_force=force)


@pytest.fixture
def clipped(hand: Hand) -> np.ndarray:
    """The efforts of the first two as files have to state them."""
    limit, sign = find_efforts(hand).limit.numpy(), np.where(np.arange(hand.tree.n_dof) % 2 == 0, 1.0, -1.0)
    return np.stack([0.5 * limit * sign, limit * sign])


def contents(hand: Hand, grasps: GraspBatch, name: str) -> Any:
    return FORMATS[name].content(ExportJob(grasps, Frame(), hand, "can"))


def test_an_effort_does_the_work_of_all_joints_that_follow(hand: Hand) -> None:
    """MuJoCo turns forces at the fingertips into torques of all joints; what follows works through its leader's motor."""
    tree, model, rng = hand.tree, hand.description.model, np.random.default_rng(0)
    grasps, data, tips = posed(hand, 1), mujoco.MjData(hand.description.model), list(hand.tips)
    force = rng.normal(size=(len(tips), 3))
    poses = tree.forward(grasps.joints[0])
    points = (poses[tips, :3, 3] + (poses[tips, :3, :3] @ hand.tip_offsets[..., None])[..., 0])
    jacobian = tree.point_jacobian(poses, points, torch.tensor(tips))
    torque = torch.einsum("kc,kcd->d", torch.from_numpy(force).float(), jacobian)
    every = (tree.coupling @ grasps.joints[0] + tree.offset).numpy()
    addresses = {model.joint(j).name: j for j in range(model.njnt)}
    for name, value in zip(tree.moving_names, every, strict=True):
        data.qpos[model.jnt_qposadr[addresses[name]]] = value
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    applied = np.zeros(model.nv)
    for f, point, link in zip(force, points.double().numpy(), tips, strict=True):
        mujoco.mj_applyFT(model, data, f, np.zeros(3), point, model.body(tree.link_names[link]).id, applied)
    by_joint = np.array([applied[model.jnt_dofadr[addresses[name]]] for name in tree.moving_names])
    assert np.abs(by_joint[[name not in tree.joint_names for name in tree.moving_names]]).max() > 1e-3, "followers work, too"
    small = 0.01 * float(find_efforts(hand).limit.min() / torque.abs().max())  # far from any limit
    (message,) = yaml.safe_load(contents(hand, grasps.replace(squeeze_torque=small * torque[None]), "moveit"))
    (point,) = message["grasp_posture"]["points"]
    assert message["grasp_posture"]["joint_names"] == list(tree.joint_names)
    expected = small * np.einsum("jd,j->d", tree.coupling.numpy(), by_joint)
    np.testing.assert_allclose(point["effort"], expected, atol=2e-7 + 1e-4 * np.abs(expected).max())


def test_a_motor_that_moves_two_jaws_presses_with_half_its_effort_each(tmp_path: Path) -> None:
    more = '<limit lower="0" upper="0.03" effort="60" velocity="1"/>'
    joints = joint("a", "palm", "left", "-0.035 0 0.01", "1 0 0", more, "prismatic") + joint(
        "b", "palm", "right", "0.035 0 0.01", "-1 0 0", f'{more}<mimic joint="a"/>', "prismatic")
    hand = dro.load_hand(str(written(tmp_path, claw(joints=joints))))
    assert hand.tree.joint_names == ("a",)
    left, right = (hand.tree.link_names.index(name) for name in ("left", "right"))
    poses = hand.tree.forward(torch.tensor([0.01]))
    inward = torch.tensor([[5.0, 0.0, 0.0], [-5.0, 0.0, 0.0]])  # 5 N of each jaw on the object between them
    jacobian = hand.tree.point_jacobian(poses, poses[[left, right], :3, 3], torch.tensor([left, right]))
    torque = torch.einsum("kc,kcd->d", inward, jacobian)[None]
    grasps = posed(hand, 1).replace(squeeze_torque=torque, squeeze_force=torch.tensor([10.0]))
    (message,) = yaml.safe_load(contents(hand, grasps, "moveit"))
    assert message["grasp_posture"]["points"][0]["effort"] == pytest.approx([10.0])
    assert message["max_contact_force"] == 10.0


def test_the_efforts_of_predicted_grasps_balance_their_contacts() -> None:
    """Pressed in MuJoCo, the hand's contacts ask of its joints what the file says, followers included."""
    hand, obj = loaded_hand("barrett"), load_object("can")
    grasps = dro.GraspPredictor().predict(hand, obj, num=3, seed=1, source="optimiser", candidates=2)
    messages = yaml.safe_load(contents(hand, grasps, "moveit"))
    efforts = np.array([message["grasp_posture"]["points"][0]["effort"] for message in messages])
    scene = scene_of(hand, obj, grasps, SettleConfig().protocol)
    ((_, rollout),) = rollouts(scene, hand, grasps, 1)
    rollout.close()
    rollout.press(grasps.squeeze_joints.numpy()[:, scene.actuated], 0.6)
    pressed = [balancing(scene, rollout, i) for i in range(len(grasps))]
    np.testing.assert_allclose(efforts, [torque for torque, _ in pressed], atol=0.12 * float(find_efforts(hand).limit.min()))
    forces = [message["max_contact_force"] for message in messages]
    np.testing.assert_allclose(forces, [force for _, force in pressed], rtol=0.15)
    assert np.abs(efforts).max() > 0.3 * float(find_efforts(hand).limit.min()), "nothing presses"


def balancing(scene: TrialScene, rollout: Rollout, i: int) -> tuple[np.ndarray, float]:
    """What the forces on the object ask of the independent joints now, by MuJoCo's Jacobians, and the sum of normal forces."""
    model, data, tree, found = scene.model, mujoco.MjData(scene.model), scene.hand.tree, np.zeros(6)
    for name in ("qpos", "qvel", "ctrl", "qacc_warmstart"):
        getattr(data, name)[:] = np.array(rollout.batch.bind(name))[i]
    mujoco.mj_forward(model, data)
    asked, normal = np.zeros(model.nv), 0.0
    for k, contact in enumerate(data.contact):
        bodies = model.geom_bodyid[contact.geom]
        if scene.object_body in bodies:
            mujoco.mj_contactForce(model, data, k, found)
            onto = 1.0 if bodies[1] == scene.object_body else -1.0
            force, torque = (onto * contact.frame.reshape(3, 3).T @ part for part in (found[:3], found[3:]))
            link = bodies[0] if onto > 0 else bodies[1]
            mujoco.mj_applyFT(model, data, force, torque, contact.pos, link, asked)
            normal += found[0]
    by_joint = [asked[model.joint(PREFIX + name).dofadr[0]] for name in tree.moving_names]
    return np.array(by_joint) @ tree.coupling.numpy(), normal


def test_moveit(hand: Hand, grasps: GraspBatch, clipped: np.ndarray) -> None:
    text = contents(hand, grasps, "moveit").decode()
    messages = yaml.safe_load(text)
    filled(messages, [GRASP])
    efforts = [message["grasp_posture"]["points"][0]["effort"] for message in messages]
    np.testing.assert_allclose(efforts[:2], clipped, rtol=1e-5, atol=1e-7)
    assert efforts[2] == []
    assert all(message["pre_grasp_posture"]["points"][0]["effort"] == [] for message in messages)
    assert [message["max_contact_force"] for message in messages] == [6.25, 31.0, 0.0]
    assert "# Payload of each grasp in kg: 0.8, 12.0, unknown\n" in text


def test_isaac_grasp(hand: Hand, grasps: GraspBatch, clipped: np.ndarray) -> None:
    for i, grasp in enumerate(imported(contents(hand, grasps, "isaac_grasp").decode()).values()):
        further = grasp.keys() - {"confidence", "position", "orientation", "cspace_position", "pregrasp_cspace_position"}
        if i == 2:
            assert further == {"squeeze_cspace_position"}, "what is unknown is absent"
            continue
        assert further == {"squeeze_cspace_position", "squeeze_cspace_effort", "payload", "squeeze_force"}
        assert list(grasp["squeeze_cspace_effort"]) == list(grasp["cspace_position"]) == list(grasps.joint_names)
        np.testing.assert_allclose(list(grasp["squeeze_cspace_effort"].values()), clipped[i], rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(list(grasp["squeeze_cspace_position"].values()), grasps.squeeze_joints[i], atol=1e-6)
        assert (grasp["payload"], grasp["squeeze_force"]) == ((0.8, 6.25), (12.0, 31.0))[i]


def test_csv_and_npy(hand: Hand, grasps: GraspBatch, clipped: np.ndarray, tmp_path: Path) -> None:
    lines = contents(hand, grasps, "csv").decode().splitlines()
    rows = list(csv.DictReader(lines[3:]))
    assert [[row["payload"], row["squeeze_force"]] for row in rows] == [["0.8", "6.25"], ["12.0", "31.0"], ["", ""]]
    cells = [[row[f"effort:{joint}"] for joint in grasps.joint_names] for row in rows]
    np.testing.assert_allclose(np.array(cells[:2], float), clipped, rtol=1e-5, atol=1e-7)
    assert set(cells[2]) == {""}
    assert "Efforts in Nm, in N where a joint slides" in lines[2]
    for i, content in enumerate(contents(hand, grasps, "dexgraspbench")):
        (tmp_path / "one.npy").write_bytes(content)
        entry = np.load(tmp_path / "one.npy", allow_pickle=True).item()
        if i == 2:
            assert not entry.keys() & {"squeeze_effort", "payload", "squeeze_force"}
        else:
            np.testing.assert_allclose(entry["squeeze_effort"], clipped[i], rtol=1e-5)
            assert (entry["payload"], entry["squeeze_force"]) == ((0.8, 6.25), (12.0, 31.0))[i]


@pytest.mark.parametrize("name", [name for name in FORMATS if name != "usd"])  # which is compressed, and read in test_usd
def test_grasps_without_forces_say_nothing_of_them(name: str) -> None:
    hand = loaded_hand("barrett")
    found = contents(hand, posed(hand, 2), name)
    text = b"".join([found] if isinstance(found, bytes) else found)
    for word in (b"Efforts in", b"Payload", b"squeeze_effort", b"squeeze_cspace_effort"):
        assert word not in text


def test_the_command_clips_too_and_needs_the_hand_for_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hand = loaded_hand("barrett")
    limit = find_efforts(hand).limit
    grasps = posed(hand, 1).replace(squeeze_torque=-3 * limit[None])
    grasps.save(tmp_path / "a.parquet")
    assert main(["export", str(tmp_path / "a.parquet"), "--format", "csv", "--output", str(tmp_path / "a.csv")]) == 0
    (row,) = csv.DictReader((tmp_path / "a.csv").read_text().splitlines()[3:])
    np.testing.assert_allclose([float(row[f"effort:{joint}"]) for joint in grasps.joint_names], -limit, rtol=1e-5)
    torch.testing.assert_close(squeeze_efforts(grasps), -3 * limit[None])  # without a hand, as they are
    assert dro.csv_table(grasps, Frame()).splitlines()[4].endswith(f",{-3 * round(float(limit[-1]), 7)}")


def test_forces_in_words(hand: Hand, grasps: GraspBatch) -> None:
    assert forces_in_words(0.8, 6.04) == "carries 0.8 kg, squeezes with 6 N"
    assert forces_in_words(0.0342, None) == "carries 0.034 kg"
    assert forces_in_words(None, 123.4) == "squeezes with 123 N"
    assert forces_in_words(None, None) == ""
    assert forces_of_all(grasps) == "carry 0.8 to 12 kg, squeeze with 6.2 to 31 N"
    assert forces_of_all(grasps[[0]]) == "carry 0.8 kg, squeeze with 6.2 N"
    assert forces_of_all(grasps[[2]]) == ""
    assert "payload 0.80 to 12.00 kg, squeeze force 6.25 to 31.00 N" in repr(grasps)
