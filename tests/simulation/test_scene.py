from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from trimesh.convex import convex_hull

from dro_grasp.errors import HandError, ObjectError
from dro_grasp.geometry.distance_field import Balls
from dro_grasp.hands.description.loader import self_penetration
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import ASSET_FILES, load_hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.contacts import measure_penetration
from dro_grasp.simulation.piercing import bones
from dro_grasp.simulation.protocols import protocol
from dro_grasp.simulation.scene import CACHED_SCENES, TrialScene, attach, build_scene, cached_scene
from tests.helpers.claw import ball, grasps_of, wrist_below
from tests.helpers.claw_urdf import LIMIT, claw as claw_text, joint, written
from tests.helpers.loaded_hands import loaded_hand

GRIPPER = """<mujoco><worldbody><body name="base"><geom type="box" size="0.06 0.02 0.01" mass="0.3"/>
<body name="left" pos="-0.05 0 0.04"><joint name="left" type="slide" axis="1 0 0" range="0 0.045"/>
<geom type="box" size="0.006 0.012 0.03" mass="0.05"/></body>
<body name="right" pos="0.05 0 0.04"><joint name="right" type="slide" axis="-1 0 0" range="0 0.045"/>
<geom type="box" size="0.006 0.012 0.03" mass="0.05"/></body></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def scene(hand: Hand) -> TrialScene:
    return build_scene(hand, ball(), protocol("dro"))


def test_contact_settings(scene):
    model = scene.model
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert model.opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE
    assert (model.opt.timestep, model.opt.impratio, *model.opt.gravity) == (0.005, 10, 0, 0, 0)
    touching = model.geom_bodyid == scene.object_body
    assert (model.geom_condim[touching] == 4).all()
    np.testing.assert_allclose(model.geom_friction[:, 0], 1.0)


def test_friction_of_the_protocol_reaches_every_shape(hand):
    model = build_scene(hand, ball(), replace(protocol("dro"), friction=3.0)).model
    np.testing.assert_allclose(model.geom_friction[:, 0], 3.0)


def test_servos_replace_what_the_description_says(scene):
    model = scene.model
    assert model.nu == 8
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], 3.0)
    np.testing.assert_allclose(model.actuator_biasprm[:, 1:3], [[-3.0, -0.3]] * 8)
    hand_dofs = model.dof_bodyid != scene.object_body
    np.testing.assert_allclose(model.dof_damping[hand_dofs], 0)
    np.testing.assert_allclose(model.dof_frictionloss[hand_dofs], 0)
    np.testing.assert_allclose(model.dof_armature[hand_dofs], 1e-3)
    assert not model.jnt_actfrclimited.any()


def test_mass_and_inertia_are_those_of_the_solid_ball(scene):
    mass = 500 * 4 / 3 * np.pi * 0.03**3
    assert scene.model.body_mass[scene.object_body] == pytest.approx(mass, rel=1e-6)
    np.testing.assert_allclose(scene.model.body_inertia[scene.object_body], 0.4 * mass * 0.03**2, rtol=1e-6)


def test_links_and_object_stand_where_kinematics_puts_them(scene, hand):
    q = hand.random_joints(3, torch.Generator().manual_seed(0))
    T = wrist_below(0.2, 3)
    T[1, :3, :3] = torch.tensor([[0.0, -1, 0], [0.6, 0, -0.8], [0.8, 0, 0.6]])
    data = mujoco.MjData(scene.model)
    for i, qpos in enumerate(scene.qpos(T, q)):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(scene.model, data)
        poses = hand.tree.forward(q[i])
        for k, name in enumerate(hand.tree.link_names):
            np.testing.assert_allclose(data.body(f"hand/{name}").xpos, poses[k, :3, 3], atol=1e-6)
        expected = torch.linalg.inv(T[i])
        np.testing.assert_allclose(data.body("object").xpos, expected[:3, 3], atol=1e-6)
        np.testing.assert_allclose(data.body("object").xmat.reshape(3, 3), expected[:3, :3], atol=1e-6)


def test_penetration_of_a_known_overlap(scene, hand):
    """The ball's lowest point 4 mm below the palm's face (z = 10 mm)."""
    grasps = grasps_of(hand, scene.obj, wrist_below(0.03 + 0.01 - 0.004), torch.zeros(1, 8))
    assert measure_penetration(scene, grasps).object[0] == pytest.approx(0.004, abs=3e-4)
    away = grasps_of(hand, scene.obj, wrist_below(0.08), hand.canonical_joints(1.0)[None])
    assert measure_penetration(scene, away).object[0] == 0


def test_fingers_that_cross_penetrate_the_hand_itself(scene, hand):
    grasps = grasps_of(hand, scene.obj, wrist_below(0.5, 2), torch.tensor([[1.3, 1.0] * 4, [0.0, 0.0] * 4]))
    own = measure_penetration(scene, grasps).own
    assert own[0] > 0.005
    assert own[1] == 0


def test_sliding_joints_close(tmp_path):
    """Gains of turning joints would move a sliding finger by millimetres a second."""
    file = tmp_path / "gripper.xml"
    file.write_text(GRIPPER)
    gripper = load_hand(file)
    model = build_scene(gripper, ball(0.01), protocol("dro")).model
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.02
    mujoco.mj_step(model, data, nstep=200)
    np.testing.assert_allclose(data.qpos[:2], 0.02, atol=1e-3)


def test_a_scene_is_built_once_for_a_pair_and_a_protocol(hand):
    first = cached_scene(hand, ball(), protocol("dro"))
    assert cached_scene(replace(hand), ball(), replace(protocol("dro"))) is first
    assert cached_scene(hand, ball(), protocol("strict")) is not first
    assert cached_scene(hand, ball(0.02), protocol("dro")).obj.volume < first.obj.volume
    for i in range(CACHED_SCENES):
        cached_scene(hand, ball(), replace(protocol("dro"), friction=2.0 + i / 100))
    assert cached_scene(hand, ball(), protocol("dro")) is not first  # the oldest has gone


@pytest.mark.parametrize("table", [False, True])
def test_what_was_found_of_the_hand_with_another_object_makes_the_same_scene(table: bool, monkeypatch: pytest.MonkeyPatch):
    """Bit by bit, and without looking at the hand again."""
    known, fresh = loaded_hand("barrett"), replace(loaded_hand("barrett"))
    first = build_scene(known, ball(), protocol("strict"), table)
    axes = bones(first)
    new = build_scene(fresh, ball(0.02), protocol("carry"), table)
    expected = saved(new), [(bone.body, bone.start.tolist(), bone.end.tolist(), bone.beyond) for bone in bones(new)]
    monkeypatch.setattr("dro_grasp.simulation.scene._resting_contacts", None)
    again = build_scene(known, ball(0.02), protocol("carry"), table)
    assert saved(again) == expected[0] != saved(first)
    assert [(bone.body, bone.start.tolist(), bone.end.tolist(), bone.beyond) for bone in bones(again)] == expected[1]
    assert again.model.nexclude > 0
    assert bones(again) is axes


def saved(scene: TrialScene) -> bytes:
    """All of a compiled model."""
    buffer = np.zeros(mujoco.mj_sizeModel(scene.model), np.uint8)
    mujoco.mj_saveModel(scene.model, None, buffer)
    return buffer.tobytes()


def test_objects_of_one_mesh_that_collide_otherwise_have_scenes_of_their_own(hand):
    """As a built-in object with exact parts and the same mesh from a user's file, which is cut into others."""
    whole = ball()
    vertices, _ = whole.parts[0]
    halves = tuple((half, convex_hull(half).faces) for half in (vertices[vertices[:, 0] >= 0], vertices[vertices[:, 0] <= 0]))
    heavy = replace(whole, inertia=2 * whole.inertia)
    balls = replace(whole, balls=Balls(torch.zeros(1, 3), torch.tensor([0.03])))
    smaller = replace(whole, balls=Balls(torch.zeros(1, 3), torch.tensor([0.02])))
    others = [whole, replace(whole, exact_parts=halves), heavy, balls, smaller, whole.coarse]
    assert {obj.sha256 for obj in others} == {whole.sha256}
    first = [cached_scene(hand, obj, protocol("dro")) for obj in others]
    assert len({id(scene) for scene in first}) == len(others)
    for scene, obj in zip(first, others, strict=True):
        own = build_scene(hand, obj, protocol("dro")).model
        assert scene.model.ngeom == own.ngeom
        np.testing.assert_array_equal(scene.model.geom_size, own.geom_size)
        np.testing.assert_array_equal(scene.model.body_inertia, own.body_inertia)
        assert cached_scene(hand, replace(obj), protocol("dro")) is scene


def test_a_cloud_has_no_scene(hand):
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    cloud = ObjectModel(name="scan", cloud=points, cloud_normals=points, centre_of_mass=np.zeros(3), sha256="scan")
    for make in (build_scene, cached_scene):
        with pytest.raises(ObjectError, match="'scan' is a bare point cloud; a trial needs a mesh"):
            make(hand, cloud, protocol("dro"))


def test_a_hand_without_description_has_no_scene(hand):
    with pytest.raises(HandError, match="carries no description"):
        build_scene(replace(hand, description=None), ball(), protocol("dro"))


def touched(scene: TrialScene, hand: Hand, q: torch.Tensor, place: torch.Tensor) -> set[str]:
    """Links in contact with the object at a place in the wrist frame."""
    T = torch.eye(4)[None].clone()
    T[0, :3, 3] = -place
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.qpos(T, q[None])[0]
    mujoco.mj_fwdPosition(scene.model, data)
    bodies = scene.model.geom_bodyid[data.contact.geom].reshape(-1, 2)
    bodies = bodies[(bodies == scene.object_body).any(1)]
    return {scene.model.body(b).name.removeprefix("hand/") for b in bodies.ravel() if b != scene.object_body}


SCENES: dict[str, TrialScene] = {}
"""Scenes of `speck`, by the hand's hash."""


def speck(hand: Hand) -> TrialScene:
    """The hand and a ball too small to be in its way, built once for all tests of the hand."""
    if hand.sha256 not in SCENES:
        SCENES[hand.sha256] = build_scene(hand, ball(0.005), protocol("dro"))
    return SCENES[hand.sha256]


def deaf_links(hand: Hand) -> list[str]:
    """Links that can touch and do not notice a ball on their surface."""
    scene = build_scene(hand, ball(0.006), protocol("dro"))
    q = hand.canonical_joints()
    points = hand.points(q)
    deaf = []
    for link in hand.contact_links:
        name, mine = hand.tree.link_names[link], points[hand.link_index == link]
        if len(mine) and not any(name in touched(scene, hand, q, p) for p in mine[:: max(1, len(mine) // 8)]):
            deaf.append(name)
    return deaf


def largest_shift(hand: Hand) -> float:
    """How far links stand from where the kinematic tree has them [m], wrist joints that are held included."""
    scene = speck(hand)
    q, data = hand.canonical_joints(), mujoco.MjData(scene.model)
    data.qpos[:] = scene.qpos(wrist_below(1.0), q[None])[0]
    mujoco.mj_kinematics(scene.model, data)
    poses = {name: T[:3, 3].numpy() for name, T in zip(hand.tree.link_names, hand.tree.forward(q), strict=True)}
    bodies = [scene.model.body(b) for b in range(scene.model.nbody)]
    named = [(b.id, b.name.removeprefix("hand/")) for b in bodies if b.name.removeprefix("hand/") in poses]
    assert len(named) > len(hand.tips)
    return max(float(np.linalg.norm(data.xpos[i] - poses[name])) for i, name in named)


def test_the_scene_stands_as_the_tree_says(hand):
    assert largest_shift(hand) < 1e-5


def test_every_link_of_the_claw_collides(hand):
    assert len(hand.contact_links) == 9
    assert deaf_links(hand) == []


@pytest.mark.assets
@pytest.mark.parametrize("name", sorted(ASSET_FILES))
def test_every_link_collides_and_the_hand_closes(name: str, assets_folder: Path):
    hand = loaded_hand(f"assets/{name}")
    assert deaf_links(hand) == []
    assert largest_shift(hand) < 1e-5
    scene = speck(hand)
    data = mujoco.MjData(scene.model)
    target = hand.canonical_joints(0.6)
    data.qpos[:] = scene.qpos(wrist_below(1.0), hand.canonical_joints(0.9)[None])[0]
    data.ctrl[:] = target.numpy()[scene.actuated]
    mujoco.mj_step(scene.model, data, nstep=200)
    assert not data.warning.number.any()
    expected = scene.qpos(wrist_below(1.0), target[None])[0]
    addresses, _ = scene.hand_qpos
    # Neighbouring fingers may meet on the way; most joints arrive.
    assert np.median(np.abs(data.qpos - expected)[addresses]) < 0.03
    held = [n for n, m in zip(hand.tree.joint_names, hand.movable, strict=True) if not m]
    assert not any(f"hand/{n}" == scene.model.actuator(i).name for n in held for i in range(scene.model.nu))


def finger_pairs(hand: Hand, pairs: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """Those pairs of links that belong to two different fingers."""
    finger = dict(zip(hand.tree.link_names, hand.finger_of_link.tolist(), strict=True))
    return {p for p in pairs if -1 != finger[p[0]] != finger[p[1]] != -1}


def own_contacts(scene: TrialScene, q: torch.Tensor) -> set[tuple[str, str]]:
    """The two links of each contact of the hand with itself, far from the object."""
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.qpos(wrist_below(1.0), q[None])[0]
    mujoco.mj_fwdPosition(scene.model, data)
    bodies = scene.model.geom_bodyid[data.contact.geom].reshape(-1, 2).tolist()
    names = [sorted(scene.model.body(b).name.removeprefix("hand/") for b in pair) for pair in bodies]
    return {(first, second) for first, second in names}


SPREADING = {
    "allegro": ("index_joint_0", "middle_joint_0", "ring_joint_0"),
    "leaphand": ("index_joint_0", "middle_joint_0", "ring_joint_0"),
    "assets/allegro_left": ("joint_0.0", "joint_4.0", "joint_8.0"),
    "assets/allegro_right": ("joint_0.0", "joint_4.0", "joint_8.0"),
    "assets/leaphand": ("0", "4", "8"),
}
"""Joints that only spread fingers, all of a symmetric range, as the makers' drawings have them."""
EVERY_HAND = [
    "allegro", "barrett", "gripper3", "leaphand", "shadowhand",
    *(pytest.param(f"assets/{name}", marks=pytest.mark.assets) for name in sorted(ASSET_FILES))]


@pytest.mark.parametrize("name", EVERY_HAND)
def test_fingers_collide_wherever_their_shapes_overlap(name: str, request: pytest.FixtureRequest):
    """Against the description's own model, which nothing is excluded from: also where neighbours cross at their limits."""
    if name.startswith("assets/"):
        request.getfixturevalue("assets_folder")
    hand = loaded_hand(name)
    assert hand.description is not None
    scene, seen = speck(hand), set[tuple[str, str]]()
    drawn = torch.cat([hand.canonical_joints(1.0)[None], hand.random_joints(100, torch.Generator().manual_seed(0))])
    measured = measure_penetration(scene, grasps_of(hand, scene.obj, wrist_below(1.0, len(drawn)), drawn)).own.tolist()
    for q, own in zip(drawn, measured, strict=True):
        depths = self_penetration(hand.description, q)
        deep = finger_pairs(hand, {(min(p), max(p)) for p, depth in depths.items() if depth > 0.002})
        assert deep <= own_contacts(scene, q)
        assert own >= 0.8 * sum(depth for p, depth in depths.items() if (min(p), max(p)) in deep)
        seen |= deep
    assert len(seen) > 0 or len(hand.fingers) < 3


@pytest.mark.parametrize("name", EVERY_HAND)
def test_open_hands_do_not_jam(name: str, request: pytest.FixtureRequest):
    if name.startswith("assets/"):
        request.getfixturevalue("assets_folder")
    hand = loaded_hand(name)
    scene = speck(hand)
    for openness in (0.75, 1.0):
        q = hand.canonical_joints(openness)
        q[[hand.tree.joint_names.index(n) for n in SPREADING.get(name, ())]] = 0.0
        assert own_contacts(scene, q) == set()
        data = mujoco.MjData(scene.model)
        data.qpos[:] = scene.qpos(wrist_below(1.0), q[None])[0]
        before, data.ctrl[:] = data.qpos.copy(), q.numpy()[scene.actuated]
        mujoco.mj_step(scene.model, data, nstep=100)
        addresses, _ = scene.hand_qpos
        np.testing.assert_allclose(data.qpos[addresses], before[addresses], atol=0.015)  # limits are soft


def test_what_is_attached_with_options_of_its_own_takes_the_scenes_without_a_warning() -> None:
    scene, part = mujoco.MjSpec(), mujoco.MjSpec.from_string(
        '<mujoco><option timestep="0.001" integrator="RK4"/><size memory="1M"/><visual><map znear="0.2"/></visual><worldbody>'
        '<body name="base"><joint name="a"/><geom size="0.05"/></body></worldbody></mujoco>')
    scene.option.timestep, scene.memory = 0.004, 2**21
    attach(scene, part, scene.worldbody.add_frame())
    model = scene.compile()  # a warning of MuJoCo would be raised here
    assert (model.opt.timestep, model.opt.integrator, model.narena) == (0.004, mujoco.mjtIntegrator.mjINT_EULER, 2**21)


@pytest.mark.parametrize("stated", ['priority="1" condim="1"', 'contype="2" conaffinity="2"', 'contype="0" conaffinity="4"'])
def test_contacts_with_the_object_have_friction_whatever_a_file_says(tmp_path, stated):
    """Fingertips of published hands often take precedence in contacts, or collide by bits of their own."""
    file = tmp_path / "gripper.xml"
    file.write_text(GRIPPER.replace('<geom type="box" size="0.006', f'<geom {stated} type="box" size="0.006'))
    model = build_scene(load_hand(file), ball(0.02), protocol("dro")).model
    data = mujoco.MjData(model)
    start = int(model.jnt_qposadr[model.joint("object").id])
    data.qpos[start:start + 7] = [0, 0, 0.04, 1, 0, 0, 0]
    data.qpos[:2] = 0.025  # each finger 1 mm into the ball
    mujoco.mj_forward(model, data)
    touched = {model.body(int(model.geom_bodyid[g])).name for contact in data.contact for g in contact.geom} - {"object"}
    assert touched == {"hand/left", "hand/right"}
    assert {contact.dim for contact in data.contact} == {4}


def test_a_follower_goes_where_its_leader_takes_it(tmp_path):
    """Limits that contradict a coupling, as some published files have them, would block the whole hand."""
    follower = joint("b", "palm", "right", "0.035 0 0.01", "0 -1 0", LIMIT + '<mimic joint="a" multiplier="-1"/>')
    file = written(tmp_path, claw_text(joints=joint("a", "palm", "left", "-0.035 0 0.01") + follower))
    hand = load_hand(file)
    assert hand.description is not None
    assert [note.text for note in hand.description.notes] == [
        "has limits of 0 to 1.5, but what it follows takes it through -1.5 to 0; they are ignored"]
    model = build_scene(hand, ball(0.01), protocol("dro")).model
    data = mujoco.MjData(model)
    data.ctrl[:] = 1.0
    mujoco.mj_step(model, data, nstep=300)
    np.testing.assert_allclose(data.qpos[:2], [1.0, -1.0], atol=0.05)
