"""Rehearsals: lifts of the object as it is known, simulated before one of them is carried out.

A score is that of a floating object that is pushed in six directions. On a table fingers come from above, push the object into
it or tip it over, and then lift it: a rehearsal sees that. It needs no more than the planner has: a camera's cloud with its
estimated side will do. Ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from dro_grasp.objects.shape import ObjectModel
from dro_grasp.planning.physics import LIFT_PROTOCOL, TICK, LiftScene
from dro_grasp.planning.reachability import Feasible, Postures
from dro_grasp.planning.robot import Robot
from dro_grasp.planning.standing import moved
from dro_grasp.planning.timed_stages import closing

TIME_STEP = 0.004
"""Time step of the simulation [s] (ours)."""
APPROACH = 0.03
"""Length of the part of the approach that is rehearsed, its end [m] (ours)."""
HEIGHT = 0.08
"""Length of the part of the lift that is rehearsed, its start [m] (ours)."""
APPROACH_SECONDS = 0.3
"""Duration of this part of the approach [s] (ours)."""
CLOSING_SECONDS = 1.0
"""Duration of closing [s]. Source: as in trials."""
GRIP_SECONDS = 0.3
"""How long the hand presses then [s] (ours)."""
LIFT_SECONDS = 0.7
"""Duration of this part of the lift [s] (ours)."""
HOLD_SECONDS = 0.3
"""How long the object is held up then [s] (ours)."""
RISEN = 0.5
"""Share of this height that a held object rises at least (ours)."""
SLIPPED = 0.02
"""Farthest that it may move in the hand while it is held up [m] (ours)."""
FEWEST_LINKS = 2
"""Links that touch the object at least, once the hand has closed (ours)."""

FEW_CONTACTS = 100
"""Contacts up to which the solver against slip runs (ours): its time grows with their square, and a hand that holds an object
has some 20."""


@dataclass(frozen=True)
class Deviation:
    """What is different from what the planner thinks."""

    shift: tuple[float, float] = (0.0, 0.0)
    """The object stands elsewhere on the table [m]."""
    friction: float = 1.0
    """Factor of the friction."""
    weight: float = 1.0
    """Factor of the object's weight."""


DEVIATIONS = (Deviation(), Deviation((0.008, 0.0), 0.8, 1.3), Deviation((-0.004, 0.007), 0.8, 1.3),
              Deviation((-0.004, -0.007), 0.8, 1.3))
"""How the rehearsals of one grasp deviate: not at all, then shifted, slippery and heavy.

Ours: on training objects, half of these shifts let two of 25 grasps pass that lose the true object, and these let none."""


class Rehearsal:
    """Lifts one object again and again."""

    def __init__(self, robot: Robot, obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"]) -> None:
        """Build the scene; the robot has a table, and other things are left out."""
        if obj.is_cloud and not np.array_equal(T_world_object, np.eye(4)):  # what stands on a table has its foot there
            obj, T_world_object = moved(obj, T_world_object), np.eye(4)
        self.scene, self.T_world_object = LiftScene(robot, [obj]), T_world_object
        self.scene.model.opt.timestep = TIME_STEP
        self._gravity = self.scene.model.opt.gravity.copy()
        self._friction = self.scene.model.geom_friction.copy()

    def share(self, goal: Feasible, hand: Postures) -> float:
        """Share of the rehearsals in which the object is held; one that drops it where it is thought to be is the last."""
        if not self.holds(goal, hand, DEVIATIONS[0]):
            return 0.0
        return (1 + sum(self.holds(goal, hand, deviation) for deviation in DEVIATIONS[1:])) / len(DEVIATIONS)

    def holds(self, goal: Feasible, hand: Postures, deviation: Deviation) -> bool:
        """Approach, close, lift and hold once."""
        scene, start = self.scene, self.T_world_object.copy()
        start[:2, 3] += deviation.shift
        scene.model.opt.gravity[:] = deviation.weight * self._gravity
        scene.model.geom_friction[:] = deviation.friction * self._friction
        approach = self._within(goal.approach[::-1], APPROACH)[::-1]
        scene.begin(approach[0], hand.pregrasp)
        scene.place(0, start)
        self._follow(approach, hand.pregrasp[None], APPROACH_SECONDS)
        self._follow(approach[-1:], closing(hand), CLOSING_SECONDS)
        self._follow(approach[-1:], hand.squeeze[None], GRIP_SECONDS)
        if scene.touched(0) < FEWEST_LINKS:
            return False
        rows = self._within(goal.lift, HEIGHT)
        self._follow(rows, hand.squeeze[None], LIFT_SECONDS)
        risen, grip = scene.pose(0)[2, 3] - start[2, 3], scene.in_hand(0)
        if risen < RISEN * self._lengths(rows)[-1]:
            return False
        self._follow(rows[-1:], hand.squeeze[None], HOLD_SECONDS)
        slip = np.linalg.norm((scene.in_hand(0) - grip)[:3, 3])
        return bool(slip < SLIPPED) and scene.touched(0) >= FEWEST_LINKS

    def _within(self, rows: Float[np.ndarray, "k n_arm"], length: float) -> Float[np.ndarray, "m n_arm"]:
        """The first configurations of a straight line, and one step of it at least."""
        return rows[:1 + max(1, int(np.abs(self._lengths(rows) - length).argmin()))]

    def _lengths(self, rows: Float[np.ndarray, "k n_arm"]) -> Float[np.ndarray, " k"]:
        """How far the wrist of each configuration is from that of the first [m]."""
        places = self.scene.robot.T_world_wrist(rows)[:, :3, 3]
        return np.linalg.norm(places - places[0], axis=1)

    def _follow(self, arm: Float[np.ndarray, "k n_arm"], hand: Float[np.ndarray, "m n_dof"], seconds: float) -> None:
        """Let the servos follow waypoints, from rest to rest."""
        count = round(seconds / TICK)
        for i in range(1, count + 1):
            x = i / count
            along, rate = x * x * (3 - 2 * x), 6 * x * (1 - x) / seconds
            q, velocity = _at(arm, along)
            self.scene.command(q, rate * velocity, _at(hand, along)[0])
            few = self.scene.data.ncon <= FEW_CONTACTS
            self.scene.model.opt.noslip_iterations = LIFT_PROTOCOL.noslip if few else 0
            self.scene.advance(TICK, every=TICK)


def _at(rows: Float[np.ndarray, "k n"], along: float) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Place on a line through waypoints, 0 to 1, and its derivative by that."""
    if len(rows) == 1:
        return rows[0], np.zeros_like(rows[0])
    place = along * (len(rows) - 1)
    i = min(int(place), len(rows) - 2)
    step = rows[i + 1] - rows[i]
    return rows[i] + (place - i) * step, step * (len(rows) - 1)
