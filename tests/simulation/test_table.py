"""Trials with a table: it is there while the hand closes, and gone when the object is pulled at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import Delaunay

from dro_grasp.geometry.distance_field import Balls
from dro_grasp.geometry.se3 import roma
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import TABLE
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.loading import mesh_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.protocols import PROTOCOLS
from dro_grasp.simulation.resting import lowest_points, stands
from dro_grasp.simulation.rollout import Rollout, rollouts
from dro_grasp.simulation.scene import scene_of
from dro_grasp.simulation.trial import simulate

JAWS = """<mujoco model="jaws"><compiler autolimits="true"/><worldbody><body name="base">
<geom type="box" size=".05 .02 .01" pos="0 0 .09" mass=".2"/>
{jaws}</body></worldbody></mujoco>"""
JAW = """<body name="jaw{i}" pos="{x} 0 .04"><joint name="slide{i}" type="slide" axis="{way} 0 0" range="0 .04"/>
<geom type="box" size=".004 .008 .04" mass=".02"/></body>"""
"""Flat fingers that end at the height of the root and close along x."""


@pytest.fixture(scope="module")
def jaws(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    """A parallel gripper that points down, opens 80 mm, and has the root between the ends of its fingers."""
    file = tmp_path_factory.mktemp("jaws") / "jaws.xml"
    file.write_text(JAWS.format(jaws="".join(JAW.format(i=i, x=0.044 * side, way=-side) for i, side in enumerate((1, -1)))))
    return load_hand(file)


def block(extents: tuple[float, float, float], T: np.ndarray | None = None) -> ObjectModel:
    """A box that stands on z = 0, or where T puts it."""
    mesh = trimesh.creation.box(extents)
    mesh.apply_translation([0, 0, extents[2] / 2])
    mesh.apply_transform(np.eye(4) if T is None else T)
    return mesh_object("block", mesh, origin="block", parts=((np.asarray(mesh.vertices), np.asarray(mesh.faces)),))


def pinch(hand: Hand, obj: ObjectModel, height: float, width: float, T: np.ndarray | None = None) -> GraspBatch:
    """Both jaws against a width, their ends this high; T moves hand, object and table alike, and None leaves out the table."""
    pose = torch.eye(4)[None].clone()
    pose[:, 2, 3] = height
    closed = torch.full((1, 2), 0.04 - width / 2)
    batch = GraspBatch.create(hand, obj, pose, closed, pregrasp_joints=closed - 0.01, squeeze_joints=closed + 0.005)
    if T is None:
        return batch
    motion = torch.from_numpy(T).float()
    plane = torch.cat([motion[:3, 2], motion[:3, 2] @ motion[:3, 3:]])
    return batch.replace(T_object_wrist=motion @ pose, extra={TABLE: plane[None]})


def motion() -> np.ndarray:
    """Some motion that turns the table far from horizontal."""
    T = np.eye(4)
    T[:3, :3] = roma.rotvec_to_rotmat(torch.tensor([1.9, -0.4, 0.7])).numpy()
    T[:3, 3] = 0.1, -0.2, 0.3
    return T


def test_a_pinch_above_the_table_holds_and_one_that_starts_in_it_is_pushed(jaws: Hand) -> None:
    obj = block((0.02, 0.05, 0.02))
    held = simulate(jaws, obj, pinch(jaws, obj, 0.001, 0.02, np.eye(4)), "carry")
    assert bool(held.success[0]), held.reason
    # Without a table the height of the fingers' ends does not matter.
    assert bool(simulate(jaws, obj, pinch(jaws, obj, -0.005, 0.02), "carry").success[0])


@pytest.mark.parametrize("table", [False, True])
def test_the_table_bears_what_fingers_press_down(jaws: Hand, table: bool) -> None:
    # A wedge that the jaws touch above its widest place: they push it down, and off, unless something is below.
    mesh = trimesh.convex.convex_hull([(x, y, z) for y in (-0.02, 0.02) for x, z in
                                       ((-0.012, 0), (0.012, 0), (-0.002, 0.02), (0.002, 0.02))])
    obj = mesh_object("wedge", mesh, origin="wedge", parts=((np.asarray(mesh.vertices), np.asarray(mesh.faces)),))
    grasp = pinch(jaws, obj, 0.008, 0.008, np.eye(4) if table else None)
    scene = scene_of(jaws, obj, grasp, replace(PROTOCOLS["carry"], friction=0.1))
    (_, rollout), = rollouts(scene, jaws, grasp, workers=1)
    start, end = rollout.start.position[0], rollout.close().position[0]
    fell = start[2] - end[2]
    assert (abs(fell) < 0.002) if table else (fell > 0.01)


def test_the_table_is_there_in_both_halves_of_a_closing_that_is_looked_at_in_between(jaws: Hand) -> None:
    obj = block((0.02, 0.05, 0.02))
    grasp = pinch(jaws, obj, 0.001, 0.02, np.eye(4))
    ends = []
    for halves in ([(0, 1), (1, None)], [(0, None)]):
        (_, rollout), = rollouts(scene_of(jaws, obj, grasp, "carry"), jaws, grasp, workers=1)
        laid = np.array(rollout.batch.bind("mocap_pos"))
        for first, last in halves:
            assert np.array_equal(rollout.batch.bind("mocap_pos"), laid)
            rollout.close(first, last)
        assert not np.allclose(rollout.batch.bind("mocap_pos"), laid)
        ends.append(rollout.observe().position[0])
    assert np.allclose(*ends, atol=1e-4)


def test_frames_do_not_matter(jaws: Hand) -> None:
    T, extents = motion(), (0.02, 0.05, 0.02)
    outcomes = []
    for frame in (np.eye(4), T):
        obj = block(extents, frame)
        grasp = pinch(jaws, obj, 0.001, 0.02, frame)
        scene = scene_of(jaws, obj, grasp, "carry")
        (_, rollout), = rollouts(scene, jaws, grasp, workers=1)
        outcomes.append(rollout.close().position[0])
    assert np.allclose(*outcomes, atol=3e-4)  # both in the wrist frame


def test_the_table_goes_away_entirely(jaws: Hand) -> None:
    """However it was turned, nothing is left that the object could meet when it is pulled at."""
    T = motion()
    obj = block((0.02, 0.05, 0.02), T)
    grasp = pinch(jaws, obj, 0.03, 0.02, T)  # above the object: nothing holds it
    scene = scene_of(jaws, obj, grasp, "carry")
    (_, rollout), = rollouts(scene, jaws, grasp, workers=1)
    closed = rollout.close()
    assert closed.shift(rollout.start)[0] < 0.001  # the table bore its weight
    rest = rollout.press(np.array(rollout.ctrl), 0.5)
    assert rest.shift(closed)[0] < 0.001  # neither weight nor table acts on it any more
    moved, _, stable = rollout.push(closed, np.array([True]))
    assert bool(stable[0])
    assert moved[0, 0] > 0.09


def test_an_object_that_hangs_above_the_table_does_not_fall(jaws: Hand) -> None:
    obj = block((0.02, 0.05, 0.02))
    grasp = pinch(jaws, obj, 0.03, 0.02, np.eye(4))
    grasp = grasp.replace(extra={TABLE: torch.tensor([[0.0, 0.0, 1.0, -0.02]])})
    (_, rollout), = rollouts(scene_of(jaws, obj, grasp, "carry"), jaws, grasp, workers=1)
    assert rollout.close().shift(rollout.start)[0] < 1e-4


def test_only_grasps_with_a_table_have_one(jaws: Hand) -> None:
    obj = block((0.02, 0.05, 0.02))
    bare, laid = pinch(jaws, obj, 0.03, 0.02), pinch(jaws, obj, 0.03, 0.02, np.eye(4))
    both = GraspBatch.concatenate([bare, laid])
    assert not scene_of(jaws, obj, bare, "carry").table
    assert scene_of(jaws, obj, both, "carry").table
    rollout = Rollout(scene_of(jaws, obj, both, "carry"), both, 1)
    places = np.array(rollout.batch.bind("mocap_pos"))[:, 0]
    assert places[0, 2] == -10.0
    assert abs(places[1, 2] + 0.03) < 1e-6
    assert np.all(rollout.force[0] == 0)
    assert rollout.force[1].min() < 0


def test_lowest_points() -> None:
    rng, obj = np.random.default_rng(0), block((0.02, 0.05, 0.03), motion())
    up = rng.normal(size=(5, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    assert obj.vertices is not None
    assert np.allclose(lowest_points(obj, up), [min(float(u @ v) for v in obj.vertices) for u in up])


def made_of_balls(centres: np.ndarray, centre_of_mass: np.ndarray) -> ObjectModel:
    balls = Balls(torch.from_numpy(centres).float(), torch.full((len(centres),), 0.004))
    return replace(block((0.02, 0.05, 0.02)), balls=balls, centre_of_mass=centre_of_mass)


def test_an_estimate_stands_where_its_centre_of_mass_is_above_what_carries_it() -> None:
    rng, T = np.random.default_rng(0), motion()
    found, true = [], []
    for _ in range(60):
        feet = np.concatenate([rng.uniform(-0.03, 0.03, (4, 2)), np.zeros((4, 1))], 1)
        middle = np.append(rng.uniform(-0.02, 0.02, 2), 0.02)
        centres = np.concatenate([feet, rng.uniform([-0.05, -0.05, 0.01], 0.05, (9, 3))])
        obj = made_of_balls(centres @ T[:3, :3].T + T[:3, 3], T[:3, :3] @ middle + T[:3, 3])
        found.append(bool(stands(obj, T[None, :3, 2])[0]))
        true.append(bool(Delaunay(feet[:, :2]).find_simplex(middle[:2]) >= 0))
    assert 10 < sum(true) < 50  # of 60
    assert found == true


def test_an_estimate_that_would_fall_over_stays_where_it_was_seen(jaws: Hand) -> None:
    """One of its points is too low: the weight does not act on it. A cloud that stands is pressed on the table."""
    corners = np.array([[x, y, z] for x in (-0.01, 0.01) for y in (-0.02, 0.02) for z in (0.004, 0.03)])
    middle = np.array([0.0, 0.0, 0.017])
    low = np.append(corners, [[0.01, 0.02, -0.006]], 0)
    shifts, forces = [], []
    for centres, level in ((corners, 0.0), (low, -0.01)):
        obj = made_of_balls(centres, middle)
        grasp = pinch(jaws, obj, 0.06, 0.02).replace(extra={TABLE: torch.tensor([[0.0, 0.0, 1.0, level]])})
        (_, rollout), = rollouts(scene_of(jaws, obj, grasp, "carry"), jaws, grasp, workers=1)
        forces.append(float(np.abs(rollout.force).max()))
        shifts.append(rollout.close().shift(rollout.start)[0])
    assert forces[0] > 0
    assert forces[1] == 0
    assert max(shifts) < 1e-3
