"""The robot at home, before a motion: what touches it there is named, with what to correct."""

from __future__ import annotations

from collections.abc import Sequence

from dro_grasp.errors import PlanError, RobotError
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.planning.collisions import OBSTACLE, TARGET, CollisionChecker, open_hand
from dro_grasp.planning.robot import Robot
from dro_grasp.planning.workcell import TABLE


def refuse_contacts_at_home(checker: CollisionChecker, obj: ObjectModel, obstacles: Sequence[ObjectModel]) -> None:
    """Refuse to start where something touches the robot.

    Args:
        checker: Of the robot, the table, the obstacles and the object.
        obj: The object.
        obstacles: The obstacles, in the world's frame.

    Raises:
        PlanError: The object or an obstacle touches it.
        RobotError: The table does.
    """
    robot = checker.robot
    for contact in checker.contacts(robot.home, open_hand(robot)):
        link, other = sorted((contact.first, contact.second), key=lambda name: name in (TARGET, OBSTACLE, TABLE))
        depth = f"{-1e3 * contact.distance:.1f} mm"
        if other == TARGET:
            raise PlanError(f"object '{obj.name}' collides with {link} while the robot is at home; give its place in the "
                            "robot's world frame, or another home")
        if other == OBSTACLE:
            raise PlanError(f"obstacle {_touching(robot, obstacles)} collides with {link} while the robot is at home, by "
                            f"{depth}; cut the robot out of that cloud or mesh, correct its place in the robot's world frame, "
                            "or give another home")
        raise RobotError(f"robot '{robot.name}' collides at home: {link} and {other}, by {depth}; correct `table` in the robot "
                         "file, the camera's pose if the table was found in a cloud, or `home`")


def _touching(robot: Robot, obstacles: Sequence[ObjectModel]) -> str:
    """Names of those that collide with the robot at home."""
    opened = open_hand(robot)
    touching = [thing.name for thing in obstacles if any(
        OBSTACLE in (c.first, c.second) for c in CollisionChecker(robot, None, [thing]).contacts(robot.home, opened))]
    return ", ".join(f"'{name}'" for name in dict.fromkeys(touching))
