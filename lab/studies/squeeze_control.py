"""Whether a grasp presses as its file says, and carries, whichever way a hand is driven.

Each grasp is closed in MuJoCo by the servos that its squeeze is made for, by the efforts alone, and by targets for stiffer and
softer servos; then the object's weight pulls along six directions. Training hands and objects alone.

Run: python -m lab.studies.squeeze_control --hands allegro barrett --objects can cube --num 8
"""

# MuJoCo 4 exports its names at run time only.
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
import tyro
from jaxtyping import Float

import dro_grasp as dro
from dro_grasp.grasps.forces import squeeze_efforts
from dro_grasp.predict.settling import SettleConfig
from dro_grasp.simulation.outcome import FORCES
from dro_grasp.simulation.quiet import quiet
from dro_grasp.simulation.scene import TrialScene, scene_of, servo_joints

GRAVITY = 9.81  # [m/s^2]
FARTHEST = 0.02  # Farthest that a carried object moves [m]. Source: protocol `carry`
PRESSING = 0.8  # Time to close and press [s] (ours)
PULLING = 0.5  # Time of each pull [s] (ours)


@dataclass(frozen=True)
class Drive:
    """One way to drive a hand."""

    name: str
    stiffness: float | None  # [Nm/rad]; None commands efforts


OWN = 3.0  # Stiffness of the servos that squeezes are made for [Nm/rad]
DRIVES = (
    Drive("squeeze", OWN), Drive("efforts", None), Drive("from grasp, 1.5", 1.5), Drive("from grasp, 10", 10.0),
    Drive("from grasp, 30", 30.0), Drive("from squeeze, 1.5", 1.5), Drive("from squeeze, 10", 10.0),
    Drive("from squeeze, 30", 30.0))
"""From grasp: `grasp + effort / k`. From squeeze: `squeeze + (1 / k - 1 / 3) * effort`; at `squeeze - effort / 3` it rests."""


@dataclass(frozen=True)
class Study:
    """Hands, objects and grasps."""

    hands: tuple[str, ...] = ("allegro", "barrett", "leaphand", "gripper3")
    objects: tuple[str, ...] = ("can", "cube")
    num: int = 8

    def run(self) -> None:
        """Print a line for each drive of each hand."""
        for name in self.hands:
            hand = dro.load_hand(name)
            found: dict[str, list[tuple[float, bool]]] = {drive.name: [] for drive in DRIVES}
            for obj in map(dro.load_object, self.objects):
                grasps = dro.GraspPredictor().predict(hand, obj, num=self.num, seed=0)
                grasps = grasps[grasps.squeeze_torque.isfinite().all(1) & (grasps.squeeze_force > 0)]
                scene = scene_of(hand, obj, grasps, SettleConfig().protocol)
                for drive in DRIVES:
                    found[drive.name] += [tried(scene, hand, grasps, i, drive) for i in range(len(grasps))]
            for drive, rows in found.items():
                ratio = np.array([r for r, _ in rows])
                low, middle, high = np.quantile(ratio, [0.1, 0.5, 0.9])
                print(f"{name:10} {drive:22} carries {sum(c for _, c in rows):3} of {len(rows)}; force over stated: "
                      f"median {middle:.2f} (10 to 90 %: {low:.2f} to {high:.2f})", flush=True)


def tried(scene: TrialScene, hand: dro.Hand, grasps: dro.GraspBatch, i: int, drive: Drive) -> tuple[float, bool]:
    """Sum of normal forces as a multiple of the stated one, and whether the weight moves the object by less than FARTHEST."""
    model, (servos, joints) = scene.model.__copy__(), servo_joints(scene.model, hand)
    effort = squeeze_efforts(grasps, hand)[i].double().numpy()
    grasp, unit = grasps.joints[i].double().numpy(), hand.tree.joint_unit.double().numpy()
    command = grasps.squeeze_joints[i].double().numpy()
    if drive.stiffness is None:
        command = effort
        model.actuator_gainprm[servos, 0], model.actuator_biasprm[servos, 1] = 1.0, 0.0
    elif drive is not DRIVES[0]:
        stiffness = drive.stiffness / unit**2
        reached = grasp if drive.name.startswith("from grasp") else command - effort / (OWN / unit**2)
        command = reached + effort / stiffness
        model.actuator_gainprm[servos, 0], model.actuator_biasprm[servos, 1] = stiffness[joints], -stiffness[joints]
    data = mujoco.MjData(model)
    data.qpos[:] = scene.qpos(grasps.T_object_wrist[i:i + 1], grasps.joints[i:i + 1])[0]
    data.ctrl[servos] = command[joints]
    with quiet():
        run(model, data, PRESSING)
        force = pressure(scene, model, data)
        moved = [pulled(scene, model, data, direction) for direction in FORCES]
    return force / float(grasps.squeeze_force[i]), max(moved) < FARTHEST


def run(model: mujoco.MjModel, data: mujoco.MjData, seconds: float) -> None:
    """Let time pass [s]."""
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)


def pressure(scene: TrialScene, model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Sum of the normal forces on the object [N]."""
    total, found = 0.0, np.zeros(6)
    for k, contact in enumerate(data.contact):
        if scene.object_body in model.geom_bodyid[contact.geom]:
            mujoco.mj_contactForce(model, data, k, found)
            total += found[0]
    return total


def pulled(scene: TrialScene, model: mujoco.MjModel, closed: mujoco.MjData, direction: Float[np.ndarray, "3"]) -> float:
    """How far the weight along a direction moves the object from where it was closed [m]."""
    data = mujoco.MjData(model)
    for name in ("qpos", "qvel", "ctrl", "qacc_warmstart"):
        getattr(data, name)[:] = getattr(closed, name)
    before = data.qpos[scene.object_qpos][:3].copy()
    data.xfrc_applied[scene.object_body, :3] = GRAVITY * model.body_mass[scene.object_body] * direction
    run(model, data, PULLING)
    return float(np.linalg.norm(data.qpos[scene.object_qpos][:3] - before))


if __name__ == "__main__":
    torch.set_num_threads(1)
    tyro.cli(Study).run()
