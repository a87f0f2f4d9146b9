"""The physics of `carry` against statics on paper: friction, the torsion of soft fingers, and servos as strong as they are.

A jaw of two sliding fingers closes with a force that its description states; its targets lie beyond what the servos reach.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import trimesh

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.effort import find_efforts
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.outcome import Failure
from dro_grasp.simulation.protocols import CARRY, STRICT, Protocol
from dro_grasp.simulation.rollout import Rollout
from dro_grasp.simulation.scene import cached_scene
from dro_grasp.simulation.trial import TrialResult, simulate
from tests.helpers.claw_urdf import PALM, joint, link, written

GRAVITY = 9.81
REACH = 0.08  # From the palm to the middle of the pads [m]
WIDTH = 0.04  # Between the pads [m]
FORCE = 12.0  # Of each finger [N]


def jaw(folder: Path, pad: str, force: float = FORCE) -> Hand:
    """Two fingers that slide towards each other, each with this force [N]."""
    limit = f'<limit lower="0" upper="0.05" effort="{force}" velocity="1"/>'
    shape = f'<origin xyz="0 0 {REACH}"/><geometry>{pad}</geometry>'
    body = f"<visual>{shape}</visual><collision>{shape}</collision>"
    links = "".join(f'<link name="{name}">{body}</link>' for name in ("left", "right"))
    joints = joint("a", "palm", "left", "-0.05 0 0", "1 0 0", limit, "prismatic") + joint(
        "b", "palm", "right", "0.05 0 0", "-1 0 0", limit, "prismatic")
    return load_hand(written(folder, f'<robot name="jaw">{PALM}{links}{joints}</robot>', f"jaw{force:g}.urdf"))


BOX, BALL = '<box size="0.01 0.02 0.02"/>', '<sphere radius="0.005"/>'
INNER = 0.05 - 0.005 - WIDTH / 2  # Joint value at which both kinds of pads touch a body of this width [m]


def block(mass: float, extents: tuple[float, float, float]) -> ObjectModel:
    """A box with the mass properties of a box, as one convex part."""
    mesh = trimesh.creation.box(extents)
    cloud, faces = trimesh.sample.sample_surface(mesh, 256, seed=0)
    x, y, z = np.square(extents)
    volume = float(np.prod(extents))
    vertices, triangles = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    return ObjectModel(
        name="block", cloud=cloud.astype(np.float32), cloud_normals=mesh.face_normals[faces].astype(np.float32),
        centre_of_mass=np.zeros(3), sha256=f"block{extents}", vertices=vertices, faces=triangles, volume=volume,
        inertia=np.diag([y + z, x + z, x + y]) * volume / 12, exact_parts=((vertices, triangles),), density=mass / volume)


def pinch(hand: Hand, obj: ObjectModel, beyond: float = 0.002, aside: float = 0.0) -> GraspBatch:
    """The jaw about a body, this far aside along y; targets are `beyond` what the force reaches [m]."""
    T = torch.eye(4)[None].clone()
    T[0, 1:3, 3] = torch.tensor([aside, -REACH])
    grasp = torch.full((1, 2), INNER)
    stiffness = CARRY.stiffness / CARRY.lever**2
    squeeze = grasp + find_efforts(hand).limit / stiffness + beyond
    return GraspBatch.create(hand, obj, T, grasp).replace(pregrasp_joints=grasp - 0.002, squeeze_joints=squeeze)


def carried(hand: Hand, obj: ObjectModel, rules: Protocol = CARRY, **options: float) -> TrialResult:
    return simulate(hand, obj, pinch(hand, obj, **options), rules, workers=1)


@pytest.mark.parametrize("friction", [0.25, CARRY.friction])
@pytest.mark.parametrize("force", [6.0, 24.0])
@pytest.mark.parametrize(("share", "holds"), [(0.94, True), (1.06, False)])
def test_a_box_is_carried_exactly_when_friction_answers_its_weight(
    tmp_path: Path, friction: float, force: float, share: float, holds: bool
) -> None:
    hand, limit = jaw(tmp_path, BOX, force), 2 * friction * force / GRAVITY
    obj = block(share * limit, (WIDTH, 0.05, 0.05))
    assert obj.mass == pytest.approx(share * limit)
    result = carried(hand, obj, replace(CARRY, friction=friction))
    assert result.success.tolist() == [holds], result.failure
    assert (result.failure[0] in {Failure.LOST, Failure.SLIPPED}) != holds


def torsion(mass: float, offset: float, force: float) -> float:
    """Torque of a weight at an offset, of what two soft fingers answer beside the weight itself.

    Each contact bears half of the weight; force and torque share an ellipse: (f / mu N)^2 + (t / c N)^2 <= 1.
    """
    tangential = mass * GRAVITY / (2 * CARRY.friction * force)
    return mass * GRAVITY * offset / (2 * CARRY.torsional_friction * force * math.sqrt(1 - tangential**2))


@pytest.mark.parametrize("force", [8.0, 16.0])
@pytest.mark.parametrize(("share", "holds"), [(0.9, True), (1.1, False)])
def test_a_rod_turns_exactly_when_its_weight_exceeds_the_torsion_of_two_contacts(
    tmp_path: Path, force: float, share: float, holds: bool
) -> None:
    hand, obj = jaw(tmp_path, BALL, force), block(0.2, (WIDTH, 0.24, 0.02))
    offset = share * 0.04 / torsion(obj.mass, 0.04, force)
    assert offset < 0.11, "within the rod"
    result = carried(hand, obj, aside=offset)
    assert result.success.tolist() == [holds], result.failure
    assert (result.rotation[0, :2] < CARRY.max_rotation).all()  # pulls along x and y, which friction at two places answers
    assert bool(result.rotation[0, 2] < CARRY.max_rotation) == holds  # the pull along z turns it about the line of the fingers


def pressed(hand: Hand, obj: ObjectModel, rules: Protocol, beyond: float) -> tuple[np.ndarray, float, np.ndarray]:
    """Forces of the servos after closing, the normal force of one finger's contacts, and stiffness times the way left [N]."""
    scene = cached_scene(hand, obj, rules)
    rollout = Rollout(scene, pinch(hand, obj, beyond), workers=1)
    rollout.close()
    data, force = mujoco.MjData(scene.model), np.zeros(6)
    data.qpos[:], data.ctrl[:] = rollout.qpos[0], rollout.ctrl[0]
    data.qvel[:], data.qacc_warmstart[:] = (rollout.batch.bind(n)[0] for n in ("qvel", "qacc_warmstart"))
    mujoco.mj_forward(scene.model, data)
    left, total = scene.model.body("hand/left").id, 0.0
    for i, geoms in enumerate(data.contact.geom):
        if left in scene.model.geom_bodyid[geoms]:
            mujoco.mj_contactForce(scene.model, data, i, force)
            total += float(force[0])
    joints, _ = rollout.poses()
    return data.actuator_force.copy(), total, (rollout.ctrl[0] - joints[0]) * rules.stiffness / rules.lever**2


@pytest.mark.parametrize("beyond", [0.002, 0.02])
def test_fingers_press_with_their_effort_however_far_the_target_is(tmp_path: Path, beyond: float) -> None:
    hand, obj = jaw(tmp_path, BOX), block(0.1, (WIDTH, 0.05, 0.05))
    servos, normal, wanted = pressed(hand, obj, CARRY, beyond)
    assert wanted.min() > 1.2 * FORCE
    assert servos == pytest.approx([FORCE, FORCE], rel=1e-6)
    assert normal == pytest.approx(FORCE, rel=0.01)
    servos, normal, wanted = pressed(hand, obj, STRICT, beyond)  # whose servos know no effort, and follow the target
    assert servos == pytest.approx(wanted, rel=0.01)
    assert normal == pytest.approx(wanted[0], rel=0.02)


def test_what_a_target_within_reach_asks_for_is_what_presses(tmp_path: Path) -> None:
    hand, obj = jaw(tmp_path, BOX), block(0.1, (WIDTH, 0.05, 0.05))
    servos, normal, wanted = pressed(hand, obj, CARRY, beyond=-0.001)
    assert wanted.max() < 0.8 * FORCE
    assert servos == pytest.approx(wanted, rel=0.03)  # the servos' damping takes some
    assert normal == pytest.approx(wanted[0], rel=0.03)


def test_a_turning_joint_presses_with_its_effort_over_its_lever(tmp_path: Path) -> None:
    limit = '<limit lower="-0.5" upper="1.5" effort="{}" velocity="1"/>'
    joints = joint("a", "palm", "left", "-0.035 0 0.01", more=limit.format(0.4)) + joint(
        "b", "palm", "right", "0.035 0 0.01", "0 -1 0", limit.format(0.3))
    text = f'<robot name="claw">{PALM}{link("left")}{link("right")}{joints}</robot>'
    hand = load_hand(written(tmp_path, text))
    scene = cached_scene(hand, block(0.1, (WIDTH, 0.05, 0.05)), CARRY)
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = model.qpos0
    stops = [model.joint(f"hand/{n}") for n in "ab"]
    for stop in stops:
        data.qpos[stop.qposadr[0]] = 1.5
    data.ctrl[:] = 4.0  # a radian is 3 Nm: both ask for more than they have
    for _ in range(400):
        mujoco.mj_step(model, data)
    assert data.actuator_force == pytest.approx([0.4, 0.3], rel=1e-6)
    held = [-float(data.qfrc_constraint[stop.dofadr[0]]) for stop in stops]  # what the stops answer
    assert held == pytest.approx([0.4, 0.3], rel=0.01)
