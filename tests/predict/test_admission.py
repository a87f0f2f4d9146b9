"""Constraints through the chain, checked by the hand's collision shapes against boxes, balls and the object's triangles."""

from __future__ import annotations

import dataclasses
import math
from functools import cache
from itertools import pairwise

import igl
import numpy as np
import pytest
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import ObjectError, OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.anatomy import PALM
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.scenery import Scene, load_scene
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.admission import (
    BESIDE,
    NARROW,
    OBSTACLES,
    PLANE,
    SPARED,
    TURNED,
    AdmissionConfig,
    clear,
    count_violations,
    feasible,
)
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.shortage import Tally
from dro_grasp.predict.sources.optimiser import OptimiserSource
from dro_grasp.predict.stages import refine
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.toy_hand import toy_hand

HAND = loaded_hand("gripper3")
MUG = load_object("mug")
BALL = load_object("sphere")
SEEN_ON_A_TABLE = dataclasses.replace(BALL, vertices=None, faces=None, table=np.array([0.0, 0.0, 1.0, -0.2], np.float32))
FLOOR = float(MUG.cloud[:, 2].min())
RIM = (0.0, 0.0, 0.045)
WALL, WALL_CENTRE = np.array([0.02, 0.4, 0.4]), np.array([-0.075, 0.0, 0.0])
BAR, BAR_CENTRE = np.array([0.03, 0.4, 0.03]), np.array([0.0, 0.0, 0.12])
BOXES = ((WALL, WALL_CENTRE), (BAR, BAR_CENTRE))
SCENE = trimesh.util.concatenate([
    trimesh.creation.box(extents=size, transform=trimesh.transformations.translation_matrix(at)) for size, at in BOXES])
DOTS = trimesh.sample.sample_surface(SCENE, 20_000, seed=0)[0]
BESIDE_HANDLE, LOWER = (0.055, 0.0, 0.0, 0.03), (0.0, 0.0, -0.045, 0.03)
CASES = {
    "mesh": Constraints(obstacles=load_scene(SCENE)),
    "cloud": Constraints(obstacles=load_scene(DOTS)),
    "max_tilt": Constraints(direction=(0.0, 0.6, -0.8), max_tilt=0.3),
    "contact_region": Constraints(contact_region=((*RIM, 0.055),)),
    "keep_out": Constraints(keep_out=(BESIDE_HANDLE, LOWER)),
    "pregrasp_clearance": Constraints(pregrasp_clearance=0.01),
    "table": Constraints(direction=(1.0, 0.0, 0.0), table=FLOOR),
}
REASONS = {
    "mesh": OBSTACLES, "cloud": OBSTACLES, "max_tilt": TURNED, "contact_region": BESIDE, "keep_out": SPARED,
    "pregrasp_clearance": NARROW, "table": PLANE}


@cache
def samples() -> list[tuple[int, Float[np.ndarray, "n 3"]]]:
    """Points on the collision shapes, by link; no stage reads these shapes [m]."""
    assert HAND.description is not None
    hulls = [(s.link, trimesh.convex.convex_hull(s.vertices)) for s in HAND.description.geometry if s.collides]
    return [(link, np.vstack([hull.vertices, hull.sample(300, seed=0)])) for link, hull in hulls]


def shapes(T: Tensor, q: Tensor, closing_only: bool = False) -> Float[np.ndarray, "n 3"]:
    """Points on the posed hand [m]; all, or those on links that close."""
    poses = (T.double() @ HAND.tree.forward(q).double()).numpy()
    closing = HAND.tree.moves[:, HAND.movable & ~HAND.abduction].any(-1) & (HAND.finger_of_link != PALM)
    return np.concatenate([
        points @ poses[link, :3, :3].T + poses[link, :3, 3] for link, points in samples() if closing[link] or not closing_only])


def postures(grasps: GraspBatch, row: int) -> list[tuple[Tensor, Tensor]]:
    """Wrist poses and joints from the start of the approach to the squeeze."""
    T, opened = grasps.T_object_wrist[row], HAND.canonical_joints(1.0)
    start = T.clone()
    start[:3, 3] -= 0.1 * HAND.palm_directions(T)
    found = [(T, grasps.joints[row]), (T, grasps.squeeze_joints[row]), (start, opened)]
    for way in np.linspace(0, 0.1, 15):
        back = T.clone()
        back[:3, 3] -= way * HAND.palm_directions(T)
        found.append((back, grasps.pregrasp_joints[row]))
    return found


def box_distance(points: Float[np.ndarray, "n 3"]) -> float:
    """Least signed distance to the boxes [m]."""
    outside = [np.abs(points - centre) - size / 2 for size, centre in BOXES]
    return float(min((np.linalg.norm(o.clip(0), axis=1) + o.max(1).clip(max=0)).min() for o in outside))


def mesh_distance(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Distance to the mug's triangles [m]."""
    return np.sqrt(igl.point_mesh_squared_distance(points, MUG.vertices, np.asarray(MUG.faces, np.int64))[0])


def shortfall(case: str, grasps: GraspBatch, row: int) -> float:
    """By how much a grasp violates the constraint of a case [m or rad]; negative where it is respected."""
    T, ways = grasps.T_object_wrist[row], postures(grasps, row)
    every = [shapes(pose, q) for pose, q in ways]
    if case in ("mesh", "cloud"):
        return -min(map(box_distance, every))
    if case == "table":
        return FLOOR - min(points[:, 2].min() for points in every)
    if case == "keep_out":
        return -min(float((np.linalg.norm(p - ball[:3], axis=1) - ball[3]).min())
                    for p in every for ball in (BESIDE_HANDLE, LOWER))
    if case == "max_tilt":
        return math.acos(float(HAND.palm_directions(T) @ torch.tensor([0.0, 0.6, -0.8]))) - 0.3
    if case == "pregrasp_clearance":
        return 0.01 - float(mesh_distance(shapes(T, grasps.pregrasp_joints[row], closing_only=True)).min())
    points = shapes(T, grasps.joints[row])
    touching = points[mesh_distance(points) < 0.0015]
    return float((np.linalg.norm(touching - RIM, axis=1) - 0.055).max()) if len(touching) else -1.0


@pytest.fixture(scope="module")
def free() -> GraspBatch:
    problem = GraspProblem(HAND, MUG)
    return refine(problem, OptimiserSource().propose(problem, 4, seed=0).grasps)


@pytest.mark.parametrize("case", CASES)
def test_grasps_that_are_permitted_respect_the_constraint(case: str, free: GraspBatch) -> None:
    problem = GraspProblem(HAND, MUG, constraints=CASES[case])
    found = refine(problem, OptimiserSource().propose(problem, 4, seed=0).grasps)
    kept = found[feasible(problem, found)]
    assert len(kept) >= 1
    worst = max(shortfall(case, kept, row) for row in range(len(kept)))
    assert worst < 0.002, "surface points are sparse, but not that sparse"
    violating = [shortfall(case, free, row) > 0.002 for row in range(len(free))]
    assert sum(violating) >= 1, "the case asks for nothing"
    respected = feasible(problem, free)
    assert not (respected & torch.tensor(violating)).any()
    assert count_violations(problem, free) == {REASONS[case]: int((~respected).sum())}


def test_reasons_are_counted_once_each(free: GraspBatch) -> None:
    both = Constraints(direction=(1.0, 0.0, 0.0), max_tilt=0.01, keep_out=(LOWER,))
    problem = GraspProblem(HAND, MUG, constraints=both)
    counted = count_violations(problem, free)
    assert sum(counted.values()) == int((~feasible(problem, free)).sum()) == len(free)
    assert set(counted) <= {SPARED, TURNED}


@pytest.mark.parametrize(("given", "message"), [
    ({"max_tilt": 0.5}, "an angle from direction, which is absent"),
    ({"direction": (0.0, 0.0, -1.0), "max_tilt": 0.0}, "max_tilt is 0.0; give the largest angle in radians, above 0"),
    ({"direction": (0.0, 0.0, -1.0), "max_tilt": 30.0}, "30 degrees are 0.524"),
    ({"direction": (0.0, 0.0, -1.0), "max_tilt": 200.0}, "at most 3.14$"),
    ({"contact_region": ((0.0, 0.0, 0.0, 0.0),)}, "radius above 0 in metres"),
    ({"keep_out": ((0.0, 0.0, math.nan, 0.1),)}, "keep_out has the ball"),
    ({"contact_region": ((0.0, 0.0, 0.0, 0.1),) * 1001}, "at most 1000"),
    ({"pregrasp_clearance": 0.0}, "pregrasp_clearance is 0.0; give metres"),
    ({"pregrasp_clearance": math.inf}, "pregrasp_clearance is inf"),
])
def test_what_is_no_constraint_is_refused(given: dict[str, object], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        Constraints(**given)  # type: ignore[arg-type]


def test_what_leaves_nothing_of_the_object_is_refused() -> None:
    for constraints, message in (
        (Constraints(contact_region=((0.0, 0.0, 0.5, 0.05),)), "contact_region is not on the object: 0 of"),
        (Constraints(keep_out=((0.0, 0.0, 0.0, 0.5),)), "keep_out leaves nothing to touch"),
        (Constraints(contact_region=((*RIM, 0.05),), keep_out=((*RIM, 0.06),)),
         "keep_out leaves nothing of contact_region to touch"),
    ):
        with pytest.raises(OptionError, match=message):
            GraspProblem(HAND, MUG, constraints=constraints)
    assert MUG.vertices is not None
    assert MUG.faces is not None
    for source in ((MUG.vertices, MUG.faces), MUG.cloud, MUG.cloud[MUG.cloud_normals[:, 0] > 0]):
        own = load_scene(source)
        with pytest.raises(ObjectError, match="contains object 'mug'"):
            GraspProblem(HAND, MUG, constraints=Constraints(obstacles=own))


def test_an_object_may_stand_on_the_scene() -> None:
    board = trimesh.creation.box(extents=(0.4, 0.4, 0.02))
    board.apply_translation([0, 0, FLOOR - 0.01])
    for scene in (load_scene(board), load_scene(board.sample(40_000, seed=0))):
        GraspProblem(HAND, MUG, constraints=Constraints(obstacles=scene))


def test_a_scene_has_the_distances_of_its_boxes() -> None:
    low, high = np.full(3, -0.2), np.full(3, 0.2)
    mesh, cloud = (load_scene(source).near(low, high) for source in (SCENE, DOTS))
    assert mesh is not None
    assert cloud is not None
    points = np.random.default_rng(0).uniform(-0.19, 0.19, (2000, 3))
    true = np.array([box_distance(p[None]) for p in points])
    near = (true > 0.001) & (true < 0.02)
    for field, slack in ((mesh, 0.001), (cloud, 0.005)):
        found = field.distances(torch.from_numpy(points).float())[0].numpy()
        assert np.abs(found - true)[near].max() < slack + 0.001
        assert (found[true > 0.03] > 0.02).all()
    inside = mesh.distances(torch.from_numpy(WALL_CENTRE[None]).float())[0]
    assert float(inside) == pytest.approx(-0.01, abs=0.002)
    assert load_scene(DOTS).near(np.full(3, 1.0), np.full(3, 1.2)) is None, "nothing of it is there"
    both = load_scene(SCENE).joined(load_scene(DOTS)).near(low, high)
    assert both is not None
    places = torch.from_numpy(np.random.default_rng(0).uniform(low, high, (200, 3))).float()
    apart = torch.stack([field.distances(places)[0] for field in (mesh, cloud)]).min(0).values
    assert (both.distances(places)[0] - apart).abs().max() < 0.004  # the grids differ


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_a_scene_is_scaled_by_a_positive_number(scale: float) -> None:
    with pytest.raises(ObjectError, match="give a positive number, for example"):
        load_scene(DOTS, scale=scale)


def test_scenes_that_are_none_are_refused(tmp_path) -> None:
    with pytest.raises(ObjectError, match="no file at"):
        load_scene(tmp_path / "nowhere.ply")
    for points, message in (
        (np.zeros((0, 3)), "holds no point"), (np.full((4, 3), np.nan), "holds no point"),
        (np.ones((4, 2)), r"expected \(n, 3\)"), (np.full((4, 3), 5000.0), "Divide millimetres by 1000"),
    ):
        with pytest.raises(ObjectError, match=message):
            load_scene(points)
    np.save(tmp_path / "dots.npy", 1000 * DOTS)
    read = load_scene(tmp_path / "dots.npy", scale=0.001)
    assert repr(read).startswith("Scene('dots', cloud of ")
    moved = read.moved(trimesh.transformations.translation_matrix([0, 0, 1.0]))
    assert isinstance(moved, Scene)
    np.testing.assert_allclose(moved.points[:, 2], read.points[:, 2] + 1.0)


def test_how_much_a_grasp_may_miss_is_configured(free: GraspBatch) -> None:
    """With more room to keep fewer are let pass, and with less room more; a place is held with as many fingers as are asked."""
    problem = GraspProblem(HAND, MUG, constraints=CASES["keep_out"])
    assert problem.surroundings is not None
    passed = [int(feasible(problem, free, AdmissionConfig(least_clearance=least)).sum()) for least in (-1.0, 0.002, 1.0)]
    assert passed == [len(free), int(clear(problem, free, problem.surroundings).sum()), 0]
    around = GraspProblem(HAND, MUG, constraints=Constraints(contact_region=((0.0, 0.0, 0.0, 1.0),)))
    enough = [feasible(around, free, AdmissionConfig(fewest_fingers=count)) for count in (0, 1, 2, 3)]
    assert bool(enough[0].all())
    assert all(bool((more <= fewer).all()) for fewer, more in pairwise(enough))
    assert not feasible(around, free, AdmissionConfig(reach=-1.0)).any(), "no finger is as near as that"


@pytest.mark.parametrize(
    ("obj", "table", "reason", "said"),
    [(SEEN_ON_A_TABLE, None, PLANE, "state the table's height if it is lower than the one found in the cloud"),
     (SEEN_ON_A_TABLE, -0.3, PLANE, "lower table (now -0.3 m"),
     (SEEN_ON_A_TABLE, -9.1e-06, PLANE, "lower table (now 0 m"),
     (SEEN_ON_A_TABLE, None, TURNED, "Try another seed")])
def test_a_table_is_named_where_it_was_given_or_found(obj: ObjectModel, table: float | None, reason: str, said: str) -> None:
    problem = GraspProblem(toy_hand(), obj, constraints=Constraints(table=table))
    words = Tally(1, 2, {reason: 1}).in_words(problem, 2, alone=False)
    assert said in words
    assert ("found in the cloud" in words) == ("found in the cloud" in said)
