"""A ROS 2 node: a camera's cloud and a place in, trajectories of arm and hand out. Needs ROS 2, and the extra `arm`.

    python grasp_node.py --ros-args -p robot:=my_robot.yaml -r points:=/camera/depth/points

    in   points     sensor_msgs/PointCloud2       in the frame of the robot file's camera: table and what stands on it
    in   grasp_at   geometry_msgs/PointStamped    on the object that is wanted, in the robot's world; it starts the work
    out  arm, hand  trajectory_msgs/JointTrajectory    with the same times, in the numbers that the drivers take
    out  squeeze    sensor_msgs/JointState        targets of the hand while it holds, and their efforts
    out  held, empty  sensor_msgs/JointState      where its joints are then, with the object in the hand and without
    out  grasps     geometry_msgs/PoseArray       wrists of all grasps that were found, the best first

Send `arm` and `hand` to your controllers yourself, once you have looked at them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

import dro_grasp as dro

KINDS = {"arm": "trajectory_msgs/JointTrajectory", "hand": "trajectory_msgs/JointTrajectory",
         "squeeze": "sensor_msgs/JointState", "held": "sensor_msgs/JointState",
         "empty": "sensor_msgs/JointState", "grasps": "geometry_msgs/PoseArray"}


def planned(
    robot: dro.Robot, predictor: dro.GraspPredictor, points: np.ndarray, at: tuple[float, float, float]
) -> dict[str, Any]:
    """Messages by topic, as plain values, for the object at a place of the world [m]."""
    assert robot.camera is not None
    picked = dro.pick_object(dro.load_scene(points, camera=robot.camera.as_seen()), robot, at, name="seen")
    plan = dro.plan(picked.robot, picked.obj, obstacles=picked.obstacles, predictor=predictor)
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": plan.notes.frame}
    best = np.argsort(-plan.scene.score, kind="stable")
    return yaml.safe_load(dro.trajectory_yaml(plan)) | {
        "grasps": {"header": header, "poses": [pose(plan.scene.T_world_wrist[i]) for i in best]}}


def pose(T: np.ndarray) -> dict[str, dict[str, float]]:
    """A geometry_msgs/Pose of a 4x4 pose [m]."""
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    return {"position": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
            "orientation": dict(zip("xyzw", quaternion.tolist(), strict=True))}


def main() -> None:
    """Wait for clouds and places until Ctrl-C."""
    import rclpy
    from geometry_msgs.msg import PointStamped
    from rclpy.node import Node
    from rosidl_runtime_py.set_message import set_message_fields
    from rosidl_runtime_py.utilities import get_message
    from sensor_msgs.msg import PointCloud2
    from sensor_msgs_py.point_cloud2 import read_points_numpy

    class GraspNode(Node):
        """Plans for the last cloud, whenever a place comes."""

        def __init__(self) -> None:
            super().__init__("dro_grasp")
            self.robot = dro.load_robot(str(self.declare_parameter("robot", "xarm7_leaphand").value))
            if self.robot.camera is None:
                raise SystemExit(f"robot '{self.robot.name}' has no camera; state its pose in the robot file")
            self.predictor, self.cloud = dro.GraspPredictor(), None
            self.kinds = {topic: get_message(kind) for topic, kind in KINDS.items()}
            self.out = {topic: self.create_publisher(kind, topic, 1) for topic, kind in self.kinds.items()}
            self.create_subscription(PointCloud2, "points", self.keep, 1)
            self.create_subscription(PointStamped, "grasp_at", self.grasp, 1)

        def keep(self, cloud: Any) -> None:
            self.cloud = cloud

        def grasp(self, place: Any) -> None:
            if self.cloud is None:
                self.get_logger().error("no cloud has come yet on topic 'points'")
                return
            points = read_points_numpy(self.cloud, ("x", "y", "z")).astype(np.float64)
            try:
                messages = planned(self.robot, self.predictor, points, (place.point.x, place.point.y, place.point.z))
            except dro.DroGraspError as error:
                self.get_logger().error(str(error))
                return
            now = self.get_clock().now().to_msg()
            for topic, values in messages.items():
                message = self.kinds[topic]()
                set_message_fields(message, values)
                if "points" not in values:  # a trajectory with a time would begin then, and not when it is sent
                    message.header.stamp = now
                self.out[topic].publish(message)

    rclpy.init()
    rclpy.spin(GraspNode())


if __name__ == "__main__":
    main()
