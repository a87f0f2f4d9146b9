"""Check a robot: what is derived from its file, what collides, how far the palm reaches; and a picture of it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from dro_grasp.arm.flat.sliding import SlideConfig
from dro_grasp.arm.planning.workcell import CLEARANCE, TABLE, WORLD, Workcell
from dro_grasp.arm.robots.loading import load_robot
from dro_grasp.arm.robots.robot import CameraMount, Robot, Table
from dro_grasp.files import check_output, replacing
from dro_grasp.geometry.rendering.rasterizer import Camera, Colour, Mesh, arrow, render
from dro_grasp.hands.description.loader import Description
from dro_grasp.simulation.scene import PREFIX

SIZE = (900, 660)  # Width and height of the picture [pixels]
ALONG = 29  # Places along an edge that are looked at
VIEW = (1.0, -1.3, 0.75)  # Direction from the robot towards the camera of pictures, in the world
ARM_COLOUR: Colour = (0.84, 0.85, 0.87)  # Light grey of the arm
MOUNT_COLOUR: Colour = (0.35, 0.38, 0.43)  # Dark grey of the arm's base
HAND_COLOUR: Colour = (0.25, 0.47, 0.75)  # Blue of the hand
TABLE_COLOUR: Colour = (0.90, 0.87, 0.82)  # Sand of the table


@dataclass(frozen=True, eq=False)
class RobotReport:
    """Everything `dro-grasp robot check` says."""

    robot: Robot
    excluded: tuple[tuple[str, str], ...]
    """Pairs of links whose contacts are not checked, since they always touch."""
    home_contacts: tuple[str, ...]
    """What collides at home, in words; nothing should."""
    reach: tuple[float, float]
    """Horizontal distances from the base at which the grasp centre gets to within 10 cm above the table [m]."""
    free_share: float
    """Share of random configurations that do not collide."""
    blocking: str | None = None
    """Where all of them collide: what collides in most, in words."""

    @property
    def usable(self) -> bool:
        """Whether plans can start and go somewhere: nothing collides at home, nor everywhere."""
        return not self.home_contacts and self.free_share > 0

    def to_dict(self) -> dict[str, Any]:
        """The report for programs."""
        r = self.robot
        drivers = {name: {"zero": zero, "scale": scale} for name, zero, scale in zip(
            (*r.arm_joints, *r.hand_joints), r.drivers.zeros, r.drivers.scales, strict=True)}
        columns = ("home", "lower", "upper", "velocity", "acceleration", "effort")
        joints = {n: {c: float(getattr(r, c)[i]) for c in columns} for i, n in enumerate(r.arm_joints)}
        return {"robot": r.name, "joints": joints, "hand": r.hand.name, "hand_joints": list(r.hand_joints),
                "mount_link": r.mount_link, "wrist_at_home": r.T_world_wrist(r.home).tolist(), "camera": r.camera is not None,
                "table": None if r.table is None else r.table.height, "reach": list(self.reach), "free_share": self.free_share,
                "excluded": [list(p) for p in self.excluded], "home_contacts": list(self.home_contacts),
                "drivers": drivers, "blocking": self.blocking, "usable": self.usable}

    def lines(self) -> list[str]:
        """The report for people."""
        r = self.robot
        place = r.T_world_wrist(r.home)[:3, 3]
        of_arm = [pair for pair in self.excluded if not all(name.startswith(PREFIX) for name in pair)]
        between = [" and ".join(TABLE if name == WORLD else name.partition("/")[2] for name in pair) for pair in of_arm]
        table = "no table: plans take the plane below the object for one" if r.table is None else (
            f"table at z = {r.table.height:g} m, {r.table.size[0]:g} x {r.table.size[1]:g} m")
        camera = "no camera" if r.camera is None else (
            "camera at ({:.2f}, {:.2f}, {:.2f}) m".format(*r.camera.T_world_camera[:3, 3]))
        if r.camera is not None and r.table is not None:
            camera += f"; it shows {', '.join(shown_edges(r.camera, r.table)) or 'no edge'} of the table"
        return [
            f"robot {r.name}: {len(r.arm_joints)} arm joints, hand {r.hand.name} with {len(r.hand_joints)}, mounted at "
            f"link {r.mount_link}",
            *(f"  {n}: home {h:.2f}, {lo:.2f} to {up:.2f}, at most {v:g} /s and {a:g} /s^2" for n, h, lo, up, v, a in zip(
                r.arm_joints, r.home, r.lower, r.upper, r.velocity, r.acceleration, strict=True)),
            *(f"  {line}" for line in r.drivers.lines((*r.arm_joints, *r.hand_joints))),
            f"wrist at home: ({place[0]:.3f}, {place[1]:.3f}, {place[2]:.3f}) m; {table}; {camera}",
            f"reach: the grasp centre gets close above the table {self.reach[0]:.2f} to {self.reach[1]:.2f} m from the base"
            if np.isfinite(self.reach).all() else "reach: the grasp centre was never found close above the table",
            f"{self.free_share:.0%} of random configurations are free of collisions",
            f"not checked, since they always touch: {', '.join(between) or 'nothing'}",
            *(f"COLLISION at home: {text}" for text in self.home_contacts),
            *([f"COLLISION everywhere: {self.blocking}"] if self.blocking else []),
            "usable" if self.usable else "not usable: change `home` or the mount until nothing collides at home"
            if self.home_contacts else "not usable: change `table`, `base` or the mount until the arm can move",
        ]


def shown_edges(camera: CameraMount, table: Table) -> list[str]:
    """Edges of a table beside which an overhanging thing is within a camera's image, somewhere along them."""
    found = []
    for axis, sign in ((axis, sign) for axis in (0, 1) for sign in (-1.0, 1.0)):
        edge = table.centre[axis] + sign * table.size[axis] / 2
        points = np.full((ALONG, 3), table.height)
        points[:, axis] = edge + sign * SlideConfig().most
        points[:, 1 - axis] = table.centre[1 - axis] + np.linspace(-0.5, 0.5, ALONG) * table.size[1 - axis]
        if camera.frames(points).any():
            found.append(f"the edge {'xy'[axis]} = {edge:g}")
    return found


def check_robot(name: str | Path) -> RobotReport:
    """Load a robot and look for faults in its description.

    Args:
        name: A built-in robot, or a robot file.

    Raises:
        RobotError: The robot cannot be loaded.
    """
    robot = load_robot(name)
    cell, opened = Workcell(robot), robot.open_hand
    contacts = [f"{c.first} and {c.second} ({c.depth})" for c in cell.contacts(robot.home, opened, CLEARANCE)]
    draws = np.random.default_rng(0).uniform(robot.lower, robot.upper, (2000, len(robot.home)))
    free, blocking = np.array([cell.free(q, opened) for q in draws]), None
    if not free.any():
        met = Counter(pair for q in draws for pair in {(c.first, c.second) for c in cell.contacts(q, opened, CLEARANCE)})
        (pair, count), *_ = met.most_common(1)
        blocking = f"{pair[0]} and {pair[1]}, in {count / len(draws):.0%} of random configurations"
    centre = robot.hand.grasp_centres(torch.from_numpy(robot.T_world_wrist(draws)).float()).double().numpy()
    height = centre[:, 2] - robot.usual_table.height
    distance = np.linalg.norm(centre[:, :2] - robot.T_world_base[:2, 3], axis=1)[free & (height > 0) & (height < 0.1)]
    reach = (float(distance.min()), float(distance.max())) if len(distance) else (float("nan"), float("nan"))
    return RobotReport(robot, cell.excluded, tuple(contacts), reach, float(free.mean()), blocking)


def draw_robot(robot: Robot, path: Path) -> None:
    """Write a PNG of the robot at home, its table, and where its camera looks."""
    meshes = [*robot_meshes(robot, robot.home, robot.open_hand), *table_meshes(robot.table)]
    if robot.camera is not None:
        T = robot.camera.T_world_camera
        meshes.append(arrow(T[:3, 3], T[:3, 3] + 0.15 * T[:3, 2], (0.85, 0.2, 0.2), radius=0.008))
    points = np.concatenate([m.vertices for m in meshes])
    picture = render(meshes, Camera.around(points, VIEW, aspect=SIZE[0] / SIZE[1]), *SIZE)
    with replacing(check_output(path), "picture") as temporary:
        Image.fromarray(picture).save(temporary, format="PNG")


def robot_meshes(robot: Robot, arm: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"]) -> list[Mesh]:
    """The visual shapes of arm and hand in the world."""
    return [replace(shape, vertices=shape.vertices @ T[:3, :3].T + T[:3, 3])
            for shape, T in zip(robot_shapes(robot), shape_poses(robot, arm, hand), strict=True)]


def robot_shapes(robot: Robot) -> list[Mesh]:
    """The visual shapes of arm and hand, each in its link's frame."""
    def colour(description: Description, link: int) -> Colour:
        return HAND_COLOUR if description is not robot.arm else ARM_COLOUR if link else MOUNT_COLOUR

    return [Mesh(shape.vertices, shape.faces, colour(description, shape.link))
            for description in _parts(robot) for shape in description.geometry if shape.visual]


def shape_poses(
    robot: Robot, arm: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"]
) -> Float[np.ndarray, "n 4 4"]:
    """Where the link of each of these shapes is in the world [m]."""
    found = []
    for description in _parts(robot):
        q, root = (arm, robot.T_world_base) if description is robot.arm else (hand, robot.T_world_wrist(arm))
        poses = root @ description.tree.double.forward(torch.from_numpy(np.asarray(q, np.float64))).numpy()
        found += [poses[shape.link] for shape in description.geometry if shape.visual]
    return np.stack(found)


def _parts(robot: Robot) -> list[Description]:
    return [robot.arm, *([robot.hand.description] if robot.hand.description is not None else [])]


def table_meshes(table: Table | None) -> list[Mesh]:
    """The table as a board of 2 cm."""
    if table is None:
        return []
    import trimesh

    board = trimesh.creation.box(extents=[*table.size, 0.02])
    board.apply_translation([*table.centre, table.height - 0.01])
    return [Mesh(np.asarray(board.vertices), np.asarray(board.faces), TABLE_COLOUR)]

