"""Coarse convex parts against the shapes that they stand for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from dro_grasp.errors import ObjectError
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.convex_parts import COARSE_VERTICES, Part, coarse_parts
from tests.helpers.claw import ball


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DRO_GRASP_CACHE", str(tmp_path / "cache"))


def box(size: tuple[float, float, float], at: tuple[float, float, float]) -> Part:
    mesh = trimesh.creation.box(size)
    return np.asarray(mesh.vertices) + at, np.asarray(mesh.faces)


def volume(part: Part) -> float:
    return float(ConvexHull(part[0]).volume)


def test_the_parts_are_those_of_a_naive_search():
    """Boxes are hardly simplified, and joining is a search over all pairs, again and again."""
    rng = np.random.default_rng(0)
    parts = [box(tuple(rng.uniform(0.01, 0.03, 3)), tuple(rng.uniform(-0.05, 0.05, 3))) for _ in range(5)]
    left = [p[0] for p in parts]
    while len(left) > 3:
        cost = {}
        for i in range(len(left)):
            for j in range(i):
                whole = ConvexHull(np.concatenate([left[i], left[j]])).volume
                cost[i, j] = whole - ConvexHull(left[i]).volume - ConvexHull(left[j]).volume
        i, j = min(cost, key=cost.__getitem__)
        left = [v for k, v in enumerate(left) if k not in {i, j}] + [np.concatenate([left[i], left[j]])]
    found = coarse_parts(parts)
    np.testing.assert_allclose(sorted(map(volume, found)), sorted(ConvexHull(v).volume for v in left), rtol=0.05)


def test_thin_parts_stay_solid():
    plate = trimesh.creation.cylinder(0.03, 2e-4, sections=64)
    (kept,) = coarse_parts([(np.asarray(plate.vertices), np.asarray(plate.faces))])
    assert volume(kept) > 0.9 * plate.volume


def test_a_convex_part_keeps_its_corners_and_loses_only_fine_ones():
    cube = box((0.04, 0.05, 0.06), (0.1, 0, 0))
    (kept,) = coarse_parts([cube])
    np.testing.assert_allclose(sorted(kept[0].tolist()), sorted(cube[0].tolist()))
    (round_part,) = coarse_parts(ball(0.03).parts)
    hull = ConvexHull(round_part[0])
    assert len(round_part[0]) <= COARSE_VERTICES
    assert {tuple(v) for v in round_part[0]} <= {tuple(v) for v in ball(0.03).parts[0][0]}
    depth = 0.03 + hull.equations[:, 3].max()
    assert 0.0005 < depth < 0.09 * 0.03, "the faces lie inside, but not far"


def test_faces_look_outwards():
    for vertices, faces in coarse_parts(load_object("mug").parts):
        assert trimesh.Trimesh(vertices, faces).volume == pytest.approx(ConvexHull(vertices).volume)


def test_an_object_keeps_everything_but_its_parts():
    mug = load_object("mug")
    coarse = mug.coarse
    assert len(coarse.parts) == (len(mug.parts) + 1) // 2
    assert (coarse.name, coarse.mass) == (mug.name, mug.mass)
    assert coarse.sha256 == mug.sha256
    assert coarse.solid_sha256 != mug.solid_sha256
    fine, rough = (sum(volume(p) for p in o.parts) for o in (mug, coarse))
    assert 0.95 * fine < rough < 1.1 * fine


def test_a_bare_cloud_has_none():
    with pytest.raises(ObjectError, match="bare point cloud"):
        _ = replace(ball(), vertices=None, faces=None, exact_parts=None).coarse
