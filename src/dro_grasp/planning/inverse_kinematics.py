"""Arm configurations that bring the wrist to a pose, by differential inverse kinematics (mink)."""

from __future__ import annotations

from collections.abc import Iterable

import mink
import mujoco
import numpy as np
from jaxtyping import Float

from dro_grasp.planning.few_joints import TURNED, has_few_joints
from dro_grasp.planning.robot import Robot
from dro_grasp.planning.workcell import ARM, arm_addresses, placed_frame, wxyz
from dro_grasp.simulation.hand_part import attach

POSITION_TOLERANCE = 5e-4
"""Largest error of the wrist's position [m] (ours)."""
ROTATION_TOLERANCE = 2e-3
"""Largest error of its rotation [rad] (ours)."""
ROTATION_COST = 0.3
"""Weight of a radian against that of a metre (ours)."""
LITTLE_COST = 0.01
"""The same for arms that cannot reach every rotation, so that they are exact in position (ours)."""
ITERATIONS = 25
"""Most steps towards a pose (ours)."""
LARGEST_STEP = 0.25
"""Largest change of a joint between neighbouring poses of a straight line [rad or m]: beyond, the arm flips over (ours)."""


class WristSolver:
    """Solves for one robot; it knows no obstacles.

    An arm with few joints brings the grasp centre to its place, and turns the wrist as nearly as it can.
    """

    def __init__(self, robot: Robot) -> None:
        """Build the model of the arm and the wrist's frame."""
        scene = mujoco.MjSpec()
        attach(scene, robot.arm.spec(), placed_frame(scene.worldbody, robot.T_world_base), ARM)
        few = has_few_joints(robot)
        self._T_wrist_frame, self._turned = np.eye(4), TURNED if few else ROTATION_TOLERANCE
        if few:
            self._T_wrist_frame[:3, 3] = robot.hand.grasp_centre_wrist.double().numpy()
        frame = robot.T_link_wrist @ self._T_wrist_frame
        scene.body(ARM + robot.mount_link).add_site(name="wrist", pos=frame[:3, 3], quat=wxyz(frame[:3, :3]))
        self.model = scene.compile()
        self.addresses = arm_addresses(self.model, robot)
        self.lower, self.upper = robot.working_range
        joints = [self.model.joint(ARM + name).id for name in robot.arm_joints]
        self.model.jnt_range[joints] = np.stack([self.lower, self.upper], 1)
        self.model.jnt_limited[joints] = 1
        self._configuration = mink.Configuration(self.model)
        self._task = mink.FrameTask(
            "wrist", "site", position_cost=1.0, orientation_cost=LITTLE_COST if few else ROTATION_COST, lm_damping=1e-4)
        self._limit = mink.ConfigurationLimit(self.model)

    def solve(
        self, T_world_wrist: Float[np.ndarray, "4 4"], seeds: Iterable[Float[np.ndarray, " n_arm"]],
        iterations: int = ITERATIONS,
    ) -> Float[np.ndarray, " n_arm"] | None:
        """The configuration that the first successful seed leads to; None if none does.

        Args:
            T_world_wrist: Wanted pose [m].
            seeds: Where to start [rad or m].
            iterations: Most steps from each.
        """
        self._task.set_target(mink.SE3.from_matrix(T_world_wrist @ self._T_wrist_frame))
        for seed in seeds:
            q = np.zeros(self.model.nq)
            q[self.addresses] = np.clip(seed, self.lower, self.upper)
            self._configuration.update(q)
            for _ in range(iterations):
                if self._arrived():
                    break
                try:
                    velocity = mink.solve_ik(
                        self._configuration, [self._task], 1.0, "daqp", damping=1e-6, limits=[self._limit])
                except mink.NoSolutionFound:
                    break
                self._configuration.integrate_inplace(velocity, 1.0)
            if self._arrived():
                return np.clip(self._configuration.q[self.addresses], self.lower, self.upper)
        return None

    def follow(
        self, poses: Float[np.ndarray, "k 4 4"], start: Float[np.ndarray, " n_arm"]
    ) -> Float[np.ndarray, "k n_arm"] | None:
        """Configurations along a line of neighbouring poses, without a jump; None if there are none."""
        found = []
        for T in poses:
            q = self.solve(T, [start], 10)
            if q is None or float(np.abs(q - start).max()) > LARGEST_STEP:
                return None
            found.append(q)
            start = q
        return np.stack(found)

    def _arrived(self) -> bool:
        error = self._task.compute_error(self._configuration)
        return bool(np.linalg.norm(error[:3]) < POSITION_TOLERANCE and np.linalg.norm(error[3:]) < self._turned)

