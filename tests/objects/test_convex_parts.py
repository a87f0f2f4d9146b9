"""Coarse convex parts against the shapes that they stand for."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from dro_grasp.errors import ObjectError, OutputError
from dro_grasp.objects import convex_parts
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.convex_parts import COARSE_VERTICES, MAX_BODIES, Part, coarse_parts
from dro_grasp.objects.cutting import CutShortError, cut_apart
from dro_grasp.objects.loading import mesh_object
from dro_grasp.objects.shape import ObjectModel
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


def bumpy() -> ObjectModel:
    """A ball with dents all over, which CoACD cuts for half a minute."""
    mesh = trimesh.creation.icosphere(subdivisions=4)
    x, y, z = mesh.vertices.T
    reach = 0.05 * (1 + 0.25 * np.sin(15 * x) * np.sin(12 * y) + 0.2 * np.cos(7 * z))
    return mesh_object("bumpy", trimesh.Trimesh(mesh.vertices * reach[:, None], mesh.faces), origin="bumpy")


def apart(shape: trimesh.Trimesh, count: int) -> ObjectModel:
    """Copies of a shape, 3 cm apart, on a grid."""
    places = 0.03 * np.indices((5, 5, 5)).reshape(3, -1).T[:count]
    return mesh_object("many", trimesh.util.concatenate([shape.copy().apply_translation(at) for at in places]), origin="many")


def inside_share(obj: ObjectModel, parts: tuple[Part, ...]) -> float:
    """Share of points inside a mesh that are inside one of the parts at least."""
    rng = np.random.default_rng(0)
    points = rng.uniform(obj.vertices.min(0), obj.vertices.max(0), (4000, 3))
    points = points[trimesh.Trimesh(obj.vertices, obj.faces).contains(points)]
    hulls = [ConvexHull(vertices).equations for vertices, _ in parts]
    return float(np.any([(points @ h[:, :3].T + h[:, 3] < 1e-4).all(1) for h in hulls], axis=0).mean())


def test_when_the_time_is_over_parts_are_coarser_and_kept_and_said(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(convex_parts, "SECONDS", 2.0)
    calls: list[tuple[int, int]] = []
    obj = bumpy()
    parts = obj.cut(lambda *call: calls.append(call))
    assert 2 <= len(parts) <= convex_parts.MAX_PARTS
    assert inside_share(obj, parts) > 0.97
    assert all(trimesh.Trimesh(*part).is_convex for part in parts)
    assert calls[0] == (0, 2), "something is said at once"
    assert calls[-1] == (2, 2)
    assert "coarser, by V-HACD, because CoACD was not done after 2 s of computing" in obj.notes[-1]
    monkeypatch.setattr(convex_parts, "cut_apart", lambda *_: pytest.fail("was in the cache"))
    again = bumpy()
    assert len(again.parts) == len(parts)
    assert again.notes == obj.notes
    assert obj.solid_sha256 == again.solid_sha256


def test_what_is_cut_off_is_not_begun_anew(monkeypatch: pytest.MonkeyPatch):
    given: list[float] = []

    def cut_off(method, mesh, seconds, spent, **options):
        given.append(seconds)
        spent(12.0)
        raise KeyboardInterrupt

    monkeypatch.setattr(convex_parts, "cut_apart", cut_off)
    for _ in range(3):
        with pytest.raises(KeyboardInterrupt):
            _ = bumpy().parts
    assert given == [convex_parts.SECONDS - spent for spent in (0, 12, 24)]


def test_of_many_bodies_each_is_a_part():
    box = trimesh.creation.box((0.02, 0.01, 0.015))
    for count, left in ((50, 50), (100, MAX_BODIES)):
        obj = apart(box, count)
        parts = obj.parts
        assert len(parts) == left
        assert inside_share(obj, parts) > 0.999
        assert f"its {count} bodies" in obj.notes[-1]
        if left == count:
            assert sum(map(volume, parts)) == pytest.approx(count * box.volume)


def test_the_largest_of_many_bodies_that_are_not_convex_are_cut_further():
    ring = trimesh.creation.torus(0.01, 0.003, major_sections=16, minor_sections=8)
    obj = apart(ring, 30)
    assert inside_share(obj, obj.parts) > 0.97
    assert 30 < len(obj.parts) <= MAX_BODIES
    assert sum(map(volume, obj.parts)) < 29 * trimesh.convex.convex_hull(ring).volume
    assert "its 30 bodies are its convex parts; 8 bodies were cut further" in obj.notes[-1]


def test_of_too_many_faces_a_copy_with_fewer_is_cut(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(convex_parts, "MAX_FACES", 1000)
    monkeypatch.setattr(convex_parts, "FEWER_FACES", 400)
    ring = mesh_object("ring", trimesh.creation.torus(0.03, 0.012, major_sections=40, minor_sections=20), origin="ring")
    assert inside_share(ring, ring.parts) > 0.97
    assert "a copy with 400 of its 1600 faces" in ring.notes[-1]


def test_what_one_library_cannot_cut_the_other_does(monkeypatch: pytest.MonkeyPatch):
    def fails(method, *arguments, **options):
        if method == "coacd":
            raise CutShortError("assertion failed")
        return cut_apart(method, *arguments, **options)

    monkeypatch.setattr(convex_parts, "cut_apart", fails)
    ring = mesh_object("ring", trimesh.creation.torus(0.03, 0.012), origin="ring")
    assert inside_share(ring, ring.parts) > 0.97
    assert "because CoACD failed (assertion failed)" in ring.notes[-1]


def test_a_full_disk_for_temporary_files_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("numpy.savez", lambda *_, **__: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OutputError, match=r"No space left on device.*TMPDIR"):
        cut_apart("coacd", trimesh.creation.box(), 5.0, lambda _: None)
    assert not list(tmp_path.iterdir())


def test_reasons_come_from_the_process():
    box = trimesh.creation.box()
    with pytest.raises(CutShortError, match=r"TypeError.*nonsense"):
        cut_apart("coacd", box, 5.0, lambda _: None, nonsense=1)


def test_a_process_whose_parent_ended_before_it_began_does_nothing(tmp_path: Path):
    other = os.getppid()
    words = [sys.executable, "-m", "dro_grasp.objects.cutting_process", str(other), "coacd", "no.npz", "parts.npz", "5"]
    assert subprocess.run(words, cwd=tmp_path, check=False).returncode == 0  # it looks at no file
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_process_ends_with_the_one_that_started_it(tmp_path: Path):
    code = ("from tests.objects.test_convex_parts import bumpy\n"
            "bumpy().cut(lambda *_: print('begun', flush=True))")
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, cwd=Path(__file__).parents[2])
    assert parent.stdout is not None
    for _ in range(2):
        parent.stdout.readline()
    (child,) = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
    os.kill(parent.pid, signal.SIGKILL)
    parent.communicate()
    until = time.monotonic() + 30
    while Path(f"/proc/{child}").exists() and "Z" not in Path(f"/proc/{child}/stat").read_text().split()[2]:
        assert time.monotonic() < until, "it works on, for nobody"
        time.sleep(0.1)
