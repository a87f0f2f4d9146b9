"""Robots: their files, the arms that ship, what collides, how far they get, and how bad files are refused."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import trimesh
import yaml

import dro_grasp as dro
from dro_grasp.arm.planning.workcell import Workcell
from dro_grasp.arm.robots.loading import BUILTIN_ROBOTS, load_robot, robot_names
from dro_grasp.arm.robots.robot import CameraMount, Robot
from dro_grasp.cli.main import main
from dro_grasp.errors import RobotError
from tests.helpers.robot_files import written, xarm7
from tests.helpers.whole_robot import arm_with_claw, two_arms


@pytest.fixture
def values() -> dict[str, Any]:
    return xarm7()


@pytest.mark.parametrize("name", robot_names())
def test_a_built_in_robot_is_free_at_home_and_its_wrist_is_where_mujoco_has_it(name: str) -> None:
    robot = load_robot(name)
    cell = Workcell(robot)
    assert not cell.contacts(robot.home, robot.open_hand)
    q = np.random.default_rng(0).uniform(robot.lower, robot.upper)
    cell.contacts(q, robot.open_hand)
    body = cell.data.body(f"hand/{robot.hand.wrist_link}")
    T = robot.T_world_wrist(q)
    assert np.allclose(T[:3, 3], body.xpos, atol=1e-6)
    assert np.allclose(T[:3, :3], body.xmat.reshape(3, 3), atol=1e-6)


def dh(a: float, d: float, alpha: float, theta: float) -> np.ndarray:
    c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1.0]])


def test_the_ur5e_has_the_kinematics_that_its_maker_publishes() -> None:
    robot = load_robot("ur5e_allegro")
    table = [(0, 0.163, np.pi / 2), (-0.425, 0, 0), (-0.392, 0, 0), (0, 0.134, np.pi / 2), (0, 0.1, -np.pi / 2), (0, 0.1, 0)]
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])  # the maker's base looks the other way
    for q in np.random.default_rng(1).uniform(-3, 3, (5, 6)):
        expected = turned
        for (a, d, alpha), theta in zip(table, q, strict=True):
            expected = expected @ dh(a, d, alpha, theta)
        flange = robot.T_world_wrist(q) @ np.linalg.inv(robot.T_link_wrist)
        assert np.allclose(flange[:3, 3], expected[:3, 3], atol=1e-5)
        assert np.allclose(flange[:3, 2], expected[:3, 2], atol=1e-5)


@pytest.mark.assets
def test_the_xarm7_has_the_kinematics_of_another_model_of_it(robot: Robot, assets_folder: Path) -> None:
    other = mujoco.MjModel.from_xml_path(str(assets_folder / "arms" / "xarm7" / "xarm7.xml"))
    data = mujoco.MjData(other)
    assert np.allclose(other.jnt_range, np.stack([robot.lower, robot.upper], 1), atol=1e-4)
    for q in np.random.default_rng(2).uniform(robot.lower, robot.upper, (5, 7)):
        data.qpos[:] = q
        mujoco.mj_kinematics(other, data)
        flange = robot.T_world_wrist(q) @ np.linalg.inv(robot.T_link_wrist)
        assert np.allclose(flange[:3, 3], data.body("link7").xpos, atol=1e-5)
        assert np.allclose(flange[:3, :3], data.body("link7").xmat.reshape(3, 3), atol=1e-5)


@pytest.mark.assets
@pytest.mark.parametrize(("arm", "link", "hand"), [
    ("lite6/lite6.xml", "link6", "assets/inspire"), ("xarm7/xarm7.xml", "link7", "gripper3")])
def test_any_arm_and_any_hand_are_one_file(
    arm: str, link: str, hand: str, tmp_path: Path, assets_folder: Path, values: dict[str, Any]
) -> None:
    count = 6 if "lite6" in arm else 7
    values |= {"arm": str(assets_folder / "arms" / arm), "hand": hand, "mount": {"link": link, "position": [0, 0, 0.02]},
               "home": {f"joint{i + 1}": 0.5 for i in range(count)}}
    robot = load_robot(written(values, tmp_path))
    assert len(robot.arm_joints) == count
    assert Workcell(robot).excluded
    if "lite6" in arm:  # what its actuators state
        assert robot.effort.tolist() == [50, 50, 32, 32, 32, 20]
        assert np.allclose(robot.lower[[0, 2]], [-6.28319, -0.061087], atol=1e-4)


@pytest.mark.parametrize(("text", "name", "palm", "home"), [
    (two_arms(), "robot.urdf", "left_palm", {"left_shoulder_joint": 0.2, "left_elbow_joint": 0.4, "left_palm_joint": 0.1}),
    (arm_with_claw(), "robot.xml", "palm", {"elbow": 0.3, "wrist": 0.2})])
def test_an_arm_and_a_hand_in_one_file_need_no_mount(
    text: str, name: str, palm: str, home: dict[str, float], values: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / name).write_text(text)
    values |= {"arm": name, "hand": f"{name}#{palm}", "home": home, "limits": {"velocity": 1.0, "acceleration": 4.0}}
    del values["mount"]
    robot = load_robot(written(values, tmp_path))
    assert robot.arm_joints == tuple(home)
    assert robot.hand.wrist_link == palm
    model = mujoco.MjModel.from_xml_path(str(tmp_path / name))  # which reads the file whole
    data, q = mujoco.MjData(model), np.array([0.3, -0.2, 0.5])[: len(home)]
    for joint, value in zip(home, q, strict=True):
        data.qpos[model.joint(joint).qposadr[0]] = value
    mujoco.mj_kinematics(model, data)
    T = robot.T_world_wrist(q)
    assert np.allclose(T[:3, 3], data.body(palm).xpos, atol=1e-6)
    assert np.allclose(T[:3, :3], data.body(palm).xmat.reshape(3, 3), atol=1e-6)
    del values["hand"]
    with pytest.raises(RobotError, match=rf"lacks the entry 'mount'.*hand: {name}#LINK"):
        load_robot(written(values | {"hand": "gripper3"}, tmp_path))


def test_limits_of_an_mjcf_arm_are_read_and_those_that_it_cannot_state_are_asked_for(
    values: dict[str, Any], tmp_path: Path
) -> None:
    arm = tmp_path / "arm.xml"
    arm.write_text("""<mujoco><worldbody><body name="base"><geom size="0.05"/><body name="upper" pos="0 0 0.3">
        <joint name="a" axis="0 1 0" range="-90 60"/><geom size="0.03"/><body name="tip" pos="0 0 0.3">
        <joint name="b" axis="0 1 0" range="-45 45" actuatorfrcrange="-7 7"/><geom size="0.03"/></body></body></body>
        </worldbody><actuator><position joint="a" kp="100" forcerange="-20 20"/></actuator></mujoco>""")
    values |= {"arm": str(arm), "mount": {"link": "tip"}, "home": {"a": 0.0, "b": 0.0}, "limits": {"acceleration": 4.0}}
    with pytest.raises(RobotError, match="joints 'a' and 'b' of the arm have no velocity limit; state it in"):
        load_robot(written(values, tmp_path))
    values["limits"]["velocity"] = 1.0
    robot = load_robot(written(values, tmp_path))
    assert np.allclose(robot.lower, np.radians([-90, -45]))
    assert np.allclose(robot.upper, np.radians([60, 45]))
    assert robot.effort.tolist() == [20, 7]


def test_a_limit_that_is_no_number_is_named(values: dict[str, Any], tmp_path: Path) -> None:
    arm = tmp_path / "arm.urdf"
    text = (BUILTIN_ROBOTS / "xarm7.urdf").read_text()
    assert text.count(' velocity="') == 7
    arm.write_text(text.replace(' velocity="', ' velocity="fast" was="', 1))
    with pytest.raises(RobotError, match=r"arm\.urdf: joint 'joint1' has velocity=\"fast\"; expected a number"):
        load_robot(written(values | {"arm": str(arm)}, tmp_path))


def test_an_unusable_arm_is_named_by_the_path_that_was_given(values: dict[str, Any], tmp_path: Path) -> None:
    arm = tmp_path / "my hand" / "hands.urdf"
    arm.parent.mkdir()
    arm.write_text('<robot name="x"><link name="a"/></robot>')
    with pytest.raises(RobotError, match=rf"cannot be used: {arm} has no moving joint .*; a robot needs"):
        load_robot(written(values | {"arm": str(arm)}, tmp_path))


def change(path: str, value: Any) -> Any:
    def apply(values: dict[str, Any]) -> None:
        *above, last = path.split("/")
        for key in above:
            values = values[key]
        if value is None:
            del values[last]
        else:
            values[last] = value
    return apply


SQUASHED = [[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(("fault", "said"), [
    (change("limits/acceleration", None), "have no acceleration limit"),
    (change("limits/velocity", -1), "expected a number above 0"),
    (change("limits/velocity", 10**400), "expected a number above 0"),
    (change("home/joint2", 5.0), "outside its limits"),
    (change("limits/position", {"joint1": ["-pi", "pi"]}), "joint 'joint1' is ['-pi', 'pi']; expected [lower, upper]"),
    (change("limits/position", {"joint1": ["-3", "3"]}), "is ['-3', '3']; expected [lower, upper], numbers in rad or m"),
    (change("limits/position", {"joint1": [float("nan"), 3]}), "is [nan, 3]; expected [lower, upper]"),
    (change("limits/position", {"joint1": [-3, float("inf")]}), "is [-3, inf]; expected [lower, upper]"),
    (change("limits/position", {"joint1": [3, -3]}), "is [3, -3]; expected [lower, upper]"),
    (change("home/joint2", 10**400), "expected a number"),
    (change("home/joint2", None), "home lacks joint 'joint2'"),
    (change("camera/T_world_camera", SQUASHED), "no rigid motion"),
    (change("camera/focal", 0), "camera: focal is 0"),
    (change("camera/width", 0.5), "camera: width is 0.5; expected a whole number of pixels"),
    (change("mount/quaternion_wxyz", [1, 1, 0, 0]), "has length 1.41421"),
    (change("table/size", [0, 1]), "expected metres above 0"),
])
def test_a_bad_robot_file_is_refused_in_words(
    fault: Any, said: str, values: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = copy.deepcopy(values)
    fault(values)
    picture = tmp_path / "robot.png"
    assert main(["robot", "check", str(written(values, tmp_path)), "--picture", str(picture)]) == 2
    assert said in capsys.readouterr().err
    assert not picture.exists()


def test_an_arm_without_position_limits_needs_them_in_the_file(values: dict[str, Any], tmp_path: Path) -> None:
    arm = tmp_path / "arm.urdf"
    text = (BUILTIN_ROBOTS / "xarm7.urdf").read_text().replace('lower="-6.28319" upper="6.28319" ', "", 1)
    arm.write_text(text.replace('type="revolute"', 'type="continuous"', 1))
    values["arm"] = str(arm)
    with pytest.raises(RobotError, match="joint 'joint1' of the arm has no position limits"):
        load_robot(written(values, tmp_path))
    values["limits"]["position"] = {"joint1": [-3.0, 3.0]}
    assert load_robot(written(values, tmp_path)).lower[0] == -3.0


def test_a_camera_frames_what_its_angles_of_view_hold() -> None:
    """One that looks straight down from 2 m, 320 pixels at a focal length of 160: a metre shows as 80 pixels."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = 0.5, 0.0, 2.0
    camera = CameraMount(T, np.array([[160.0, 0, 160], [0, 160, 80], [0, 0, 1]]), 320, 160)
    places = np.array([[0.5, 0, 0], [2.4, 0, 0], [2.6, 0, 0], [-1.4, 0.9, 0], [0.5, 1.1, 0], [0.5, -1.1, 0], [0.5, 0, 2.5],
                       [2.4, 0, 1]])
    assert camera.frames(places).tolist() == [True, True, False, True, False, False, False, False]


def test_the_check_says_what_it_found_and_draws_the_robot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "robot.png"
    assert main(["robot", "check", "xarm7_leaphand", "--picture", str(picture)]) == 0
    said = capsys.readouterr().out
    assert "7 arm joints, hand leaphand with 16" in said
    assert "reach" in said
    assert "it shows the edge x = -0.15 of the table" in said
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_robot_that_collides_at_home_is_not_usable(
    values: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values["home"]["joint2"] = 1.6
    assert main(["robot", "check", str(written(values, tmp_path))]) == 2
    assert "COLLISION at home: " in capsys.readouterr().out


ARM = """<mujoco><compiler angle="radian"/><worldbody><body name="base"><geom size="0.05"/>
<body name="cart" pos="0 0 0.1"><joint name="rail" type="slide" axis="1 0 0" range="0 2"/><geom size="0.05"/>
<body name="upper" pos="0.1 0 0"><joint name="shoulder" axis="0 1 0" pos="0 0 0.3" range="-3 3"/><geom size="0.03"/>
<body name="tip" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" range="-3 3"/><geom size="0.03"/></body></body></body></body>
</worldbody></mujoco>"""
"""A rail of two metres under two joints, of which one turns about an axis off its link's origin."""


@pytest.fixture(scope="module")
def railed(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    folder = tmp_path_factory.mktemp("rail")
    (folder / "arm.xml").write_text(ARM)
    values = {"arm": "arm.xml", "hand": "gripper3", "mount": {"link": "tip", "position": [0.05, 0, 0]},
              "home": {"rail": 0.1, "shoulder": 0.2, "elbow": -0.3}, "limits": {"velocity": 1.0, "acceleration": 4.0}}
    (folder / "robot.yaml").write_text(yaml.safe_dump(values))
    return load_robot(folder / "robot.yaml")


def wrists(robot: Robot) -> torch.Tensor:
    """Poses of the wrist in the base's frame, at random and with the rail at its end."""
    arm = np.random.default_rng(0).uniform(*robot.working_range, (4000, len(robot.home)))
    arm[2000:, 0] = robot.working_range[1][0]
    return torch.from_numpy(np.linalg.inv(robot.T_world_base) @ robot.T_world_wrist(arm)).float()


def test_no_grasp_centre_and_no_fingertip_is_beyond_reach(railed: Robot, robot: dro.Robot) -> None:
    for one in (railed, robot):
        T, hand = wrists(one), one.hand
        centre = hand.grasp_centres(T).norm(dim=-1).max()
        q = hand.random_joints(len(T), torch.Generator().manual_seed(0))
        surface = hand.points(q[::20], T[::20]).norm(dim=-1).max()
        assert centre <= one.longest_reach
        assert surface <= one.full_reach
        assert centre < surface, "fingers are longer"
        assert one.longest_reach < 1.4 * centre, "the bound says something"


def test_all_that_is_wrong_with_a_robot_file_is_told_at_once(values: dict[str, Any], tmp_path: Path) -> None:
    arm = tmp_path / "arm.xml"
    arm.write_text(arm_with_key("other"))
    wrong = {"arm": str(arm), "hand": "gripper3", "table": {"size": [0, 1]}, "base": {"position": [0, 0]}, "camera": {}}
    with pytest.raises(RobotError) as refused:
        load_robot(written(wrong, tmp_path))
    for told in ("lacks the entry 'mount'", "lacks the entry 'home'", "joints 'a' and 'b' of the arm have no velocity",
                 "have no acceleration", "table: size", "base: position", "camera lacks the entry 'focal'",
                 "home: {a: 0.0, b: 0.0}"):
        assert told in str(refused.value), told
    with pytest.raises(RobotError, match="the file lacks the entries 'arm' and 'hand'"):
        load_robot(written({"name": "x"}, tmp_path))
    values["home"] |= {"joint2": 5.0, "joint3": 9.0}
    with pytest.raises(RobotError, match=r"home of joint 'joint2' is 5.*home of joint 'joint3' is 9"):
        load_robot(written(values, tmp_path))
    for joint in ("joint1", "joint7"):
        del values["home"][joint]
    with pytest.raises(RobotError, match="home lacks joints 'joint1' and 'joint7'"):
        load_robot(written(values, tmp_path))


def arm_with_key(name: str) -> str:
    return f"""<mujoco><worldbody><body name="base"><geom size="0.05"/><body name="upper" pos="0 0 0.3">
        <joint name="a" axis="0 1 0" range="-90 60"/><geom size="0.03"/><body name="tip" pos="0 0 0.3">
        <joint name="b" axis="0 1 0" range="-45 45"/><geom size="0.03"/></body></body></body></worldbody>
        <keyframe><key name="{name}" qpos="0.25 -0.5"/></keyframe></mujoco>"""


def test_the_key_home_of_an_mjcf_arm_is_home_unless_the_file_states_another(tmp_path: Path) -> None:
    arm = tmp_path / "arm.xml"
    arm.write_text(arm_with_key("home"))
    stated = {"arm": str(arm), "hand": "gripper3", "mount": {"link": "tip"}, "limits": {"velocity": 1.0, "acceleration": 4.0}}
    assert load_robot(written(stated, tmp_path)).home.tolist() == [0.25, -0.5]
    assert load_robot(written(stated | {"home": {"a": 0.0, "b": 0.1}}, tmp_path)).home.tolist() == [0.0, 0.1]


def test_key_and_efforts_of_an_mjcf_arm_are_read_whatever_its_meshes_and_textures_need(tmp_path: Path) -> None:
    trimesh.creation.box((0.05, 0.05, 0.05)).export(tmp_path / "Box.stl")
    mended = """<asset><texture name="t" type="2d" file="missing.png"/><material name="m" texture="t"/>
        <mesh name="k" file="box.STL"/></asset><actuator><position joint="a" kp="100" forcerange="-20 20"/></actuator>
        <worldbody><geom type="mesh" mesh="k" material="m"/></worldbody>"""
    (tmp_path / "arm.xml").write_text(arm_with_key("home").replace("<mujoco>", f"<mujoco>{mended}", 1))
    stated = {"arm": "arm.xml", "hand": "gripper3", "mount": {"link": "tip"}, "limits": {"velocity": 1.0, "acceleration": 4.0}}
    robot = load_robot(written(stated, tmp_path))
    assert robot.home.tolist() == [0.25, -0.5]
    assert robot.effort.tolist() == [20, 50]


@pytest.mark.parametrize(("line", "said"), [
    ("name: 2024-99-99", "cannot be read as YAML: month must be in 1..12"), ("home: {a: 0x_}", "cannot be read as YAML"),
    ("name: lab/arm", "the name is 'lab/arm'"), ("name: ..", "the name is '..'")])
def test_an_entry_that_yaml_or_a_file_name_cannot_hold_is_told(
    line: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "robot.yaml").write_text(f"arm: arm.xml\nhand: gripper3\n{line}\n")
    assert main(["robot", "check", str(tmp_path / "robot.yaml")]) == 2
    assert said in capsys.readouterr().err


def test_a_robot_knows_what_it_was_loaded_from(values: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = written(values, tmp_path)
    monkeypatch.chdir(tmp_path)
    own, again = load_robot(file.name), load_robot(file)
    assert own.source == again.source == str(file)
    assert load_robot("xarm7_leaphand").source == "xarm7_leaphand"
    file.rename(tmp_path / "renamed.yaml")
    assert load_robot("renamed.yaml").sha256 == own.sha256
