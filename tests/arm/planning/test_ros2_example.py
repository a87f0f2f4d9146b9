"""The example of a ROS 2 node, with stand-ins for ROS 2, whose messages have the fields of its interface files."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dro_grasp as dro
from dro_grasp.arm.planning.motion import MotionPlan

FIELDS = {  # Source: common_interfaces and rcl_interfaces of ROS 2
    "Header": {"stamp": "Time", "frame_id": str}, "Time": {"sec": int, "nanosec": int},
    "JointTrajectory": {"header": "Header", "joint_names": [str], "points": ["JointTrajectoryPoint"]},
    "JointTrajectoryPoint": {"positions": [float], "velocities": [float], "accelerations": [float], "effort": [float],
                             "time_from_start": "Time"},
    "JointState": {"header": "Header", "name": [str], "position": [float], "velocity": [float], "effort": [float]},
    "PoseArray": {"header": "Header", "poses": ["Pose"]}, "Pose": {"position": "Point", "orientation": "Quaternion"},
    "Point": dict.fromkeys("xyz", float), "Quaternion": dict.fromkeys("xyzw", float),
}


def made(kind: Any, values: Any = None) -> Any:
    """A message of a kind with the values, which must have its fields and types."""
    if isinstance(kind, list):
        return [made(kind[0], value) for value in values or []]
    if isinstance(kind, type):
        assert values is None or type(values) is kind, (kind, values)
        return kind() if values is None else values
    assert set(values or {}) <= FIELDS[kind].keys(), (kind, set(values) - FIELDS[kind].keys())
    return SimpleNamespace(kind=kind, **{name: made(own, (values or {}).get(name)) for name, own in FIELDS[kind].items()})


def set_message_fields(message: Any, values: dict[str, Any]) -> None:
    vars(message).update(vars(made(message.kind, values)))


class Node:
    """What the example uses of rclpy's nodes."""

    def __init__(self, name: str) -> None:
        self.errors, self.sent, self.calls = list[str](), dict[str, Any](), dict[str, Any]()

    def declare_parameter(self, name: str, value: Any) -> Any:
        return SimpleNamespace(value=value)

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        return SimpleNamespace(publish=lambda message: self.sent.update({topic: message}))

    def create_subscription(self, kind: Any, topic: str, call: Any, depth: int) -> None:
        self.calls[topic] = call

    def get_logger(self) -> Any:
        return SimpleNamespace(error=self.errors.append)

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: SimpleNamespace(sec=7, nanosec=9)))


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch, robot: dro.Robot, planned: MotionPlan) -> Node:
    """The example's node, which would plan what is planned already."""
    spun = list[Node]()
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {"init": lambda: None, "spin": spun.append}, "rclpy.node": {"Node": Node},
        "geometry_msgs": {}, "geometry_msgs.msg": {"PointStamped": object()},
        "sensor_msgs": {}, "sensor_msgs.msg": {"PointCloud2": object()},
        "sensor_msgs_py": {}, "sensor_msgs_py.point_cloud2": {"read_points_numpy": lambda cloud, names: cloud},
        "rosidl_runtime_py": {}, "rosidl_runtime_py.set_message": {"set_message_fields": set_message_fields},
        "rosidl_runtime_py.utilities": {"get_message": lambda kind: lambda: made(kind.rpartition("/")[2])},
    }
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(dro, "load_robot", lambda name: robot)
    monkeypatch.setattr(dro, "GraspPredictor", lambda: None)
    monkeypatch.setattr(dro, "plan", lambda robot, obj, obstacles, predictor: planned)
    path = Path(__file__).parents[3] / "examples" / "ros2" / "grasp_node.py"
    spec = importlib.util.spec_from_file_location("grasp_node", path)
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    example.main()
    return spun[0]


def at(x: float, y: float) -> Any:
    return SimpleNamespace(point=SimpleNamespace(x=x, y=y, z=0.05))


def test_a_place_in_a_cloud_becomes_messages(
    node: Node, planned: MotionPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr(dro, "pick_object", lambda scene, robot, at, name: asked.append(at) or SimpleNamespace(
        robot=None, obj=None, obstacles=[]))
    node.calls["points"](np.ones((4, 3), np.float32))
    node.calls["grasp_at"](at(0.5, 0.1))
    assert (asked, node.errors) == ([(0.5, 0.1, 0.05)], [])
    assert {topic: message.kind for topic, message in node.sent.items()} == {
        "arm": "JointTrajectory", "hand": "JointTrajectory", "squeeze": "JointState", "held": "JointState",
        "empty": "JointState", "grasps": "PoseArray"}
    arm, grasps = node.sent["arm"], node.sent["grasps"]
    assert (arm.joint_names, arm.header.stamp.sec) == (list(planned.notes.arm_joints), 0), "it begins when it is sent"
    assert node.sent["squeeze"].header.stamp.sec == 7
    np.testing.assert_allclose(arm.points[-1].positions, planned.arm.position[-1], atol=1e-6)
    assert arm.points[-1].time_from_start.sec == int(planned.seconds)
    best = planned.scene.T_world_wrist[planned.scene.score.argmax()]
    own = grasps.poses[0]
    np.testing.assert_allclose([own.position.x, own.position.y, own.position.z], best[:3, 3], atol=1e-6)
    turn = Rotation.from_quat([getattr(own.orientation, name) for name in "xyzw"])
    np.testing.assert_allclose(turn.as_matrix(), best[:3, :3], atol=1e-6)


def test_what_goes_wrong_is_logged_and_the_node_goes_on(node: Node) -> None:
    node.calls["grasp_at"](at(0.5, 0.1))
    node.calls["points"](np.zeros((4, 3), np.float32))
    node.calls["grasp_at"](at(0.5, 0.1))
    assert node.errors[0] == "no cloud has come yet on topic 'points'"
    assert len(node.errors) == 2
    assert "no point" in node.errors[1]
    assert node.sent == {}
