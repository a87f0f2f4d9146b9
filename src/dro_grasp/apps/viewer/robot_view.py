"""A robot beside its table, on a page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from dro_grasp.apps.viewer.scene_view import Client, move, rgb
from dro_grasp.arm.robot_check import robot_meshes, robot_shapes, shape_poses, table_meshes
from dro_grasp.arm.robots.loading import load_robot
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.errors import HandError, OptionError, RobotError
from dro_grasp.geometry.rendering.rasterizer import Colour
from dro_grasp.grasps.hold import HoldState

SIGN = 0.014  # Radius of the ball that says whether the hand holds something [m]
ABOVE_HAND = 0.16  # Its height above the wrist [m]
HOLD_COLOURS: dict[HoldState, Colour] = {
    "held": (0.20, 0.66, 0.36), "empty": (0.82, 0.28, 0.24), "slipping": (0.95, 0.6, 0.2), "unexpected": (0.5, 0.5, 0.5)}
"""Green, red, orange and grey."""


class RobotView:
    """An arm with its hand, and its table where that is drawn."""

    def __init__(self, client: Client, table: bool = True) -> None:
        """Nothing is shown before `put`; the table may be left out where a camera's cloud shows it."""
        self.client, self._table = client, table

    def put(self, robot: Robot) -> None:
        """Show a robot at home, in the place of another one."""
        scene, self.robot = self.client.scene, robot
        for name in ("/robot", "/table"):
            scene.remove_by_name(name)
        self.links = [
            scene.add_mesh_simple(f"/robot/{i}", mesh.vertices, mesh.faces, color=rgb(mesh.colour), side="double")
            for i, mesh in enumerate(robot_shapes(robot))]
        self.place(robot.home, robot.hand.canonical_joints().double().numpy())
        for i, mesh in enumerate(table_meshes(robot.table) if self._table else []):
            scene.add_mesh_simple(f"/table/{i}", mesh.vertices, mesh.faces, color=rgb(mesh.colour))

    def place(self, arm: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"]) -> None:
        """Pose arm and hand [rad or m]."""
        for handle, T in zip(self.links, shape_poses(self.robot, arm, hand), strict=True):
            move(handle, T)

    def swept(self, arm: Float[np.ndarray, "k n_arm"], hand: Float[np.ndarray, "k n_dof"]) -> Float[np.ndarray, "n 3"]:
        """Points of the robot's shapes along a motion in the world [m], for a camera that has all of them in view."""
        every = max(1, len(arm) // 6)
        meshes = [mesh for q, p in zip(arm[::every], hand[::every], strict=True) for mesh in robot_meshes(self.robot, q, p)]
        return np.concatenate([mesh.vertices for mesh in meshes])


def require_joints(robot: Robot, arm: int, hand: int, what: str) -> None:
    """Refuse a robot with other numbers of joints than a motion has, by an OptionError."""
    own = len(robot.arm_joints), len(robot.hand_joints)
    if own != (arm, hand):
        raise OptionError(f"robot '{robot.name}' has {own[0]} joints in its arm and {own[1]} in its hand, and {what} {arm} and "
                          f"{hand}; give its own robot (robot=...), or leave it out")


def robot_of(file: Path, given: str | None, recorded: str) -> Robot:
    """The robot that is given, else the one that a file of motions names.

    Raises:
        RobotError: It cannot be used, or is not where the file says.
    """
    if given is not None:
        return load_robot(given)
    try:
        return load_robot(recorded)
    except (RobotError, HandError) as error:
        raise RobotError(f"the robot of {file} cannot be loaded: {error}; or name its file now (robot=...)") from error


class HoldSign:
    """A sign above the hand that says whether it holds something."""

    def __init__(self, robot_view: RobotView) -> None:
        self._view, self._shown = robot_view, ""

    def show(self, arm: Float[np.ndarray, " n_arm"], state: tuple[HoldState, float] | None) -> None:
        """Show a state and its confidence where the hand is with these joints of the arm [rad or m]; nothing for None."""
        scene, text = self._view.client.scene, "" if state is None else f"{state[0]}, {state[1]:.0%} sure"
        if text != self._shown:
            scene.remove_by_name("/hold")
            self._shown = text
            if state is not None:
                scene.add_frame("/hold", show_axes=False)
                scene.add_icosphere("/hold/ball", SIGN, rgb(HOLD_COLOURS[state[0]]))
                scene.add_label("/hold/text", text, position=(0.0, 0.0, 2 * SIGN))
        if state is not None and (handle := scene.get_handle_by_name("/hold")) is not None:
            place = self._view.robot.T_world_wrist(arm)[:3, 3] + (0.0, 0.0, ABOVE_HAND)
            handle.position = tuple(place.tolist())
