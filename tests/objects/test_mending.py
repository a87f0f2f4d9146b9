"""What becomes of meshes with holes, notches and inverted bodies; oracles are volumes of prisms, boxes and shells."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import igl
import numpy as np
import pytest
import trimesh

from dro_grasp.objects.catalogue import load_object

NOTCHED = {
    "L": [(0, 0), (4, 0), (4, 1), (1, 1), (1, 3), (0, 3)],
    "U": [(0, 0), (5, 0), (5, 3), (4, 3), (4, 1), (1, 1), (1, 3), (0, 3)],
    "arrow": [(0, 0), (2, 3), (0, 1), (-2, 3)],
}
"""Outlines with notches, counter-clockwise [2 cm]."""


def prism(outline: list[tuple[float, float]], path: Path) -> tuple[Path, float]:
    """A file of a prism with polygons as its ends, and its volume [m^3]."""
    n, flat = len(outline), 0.02 * np.array(outline)
    x, y = flat.T
    vertices = [(*point, z) for z in (0.0, 0.02) for point in flat]
    faces = [[*range(n)][::-1], [*range(n, 2 * n)], *([i, (i + 1) % n, (i + 1) % n + n, i + n] for i in range(n))]
    rows = [" ".join(f"{value:.6f}" for value in vertex) for vertex in vertices]
    if path.suffix == ".obj":
        lines = [f"v {row}" for row in rows] + ["f " + " ".join(str(i + 1) for i in face) for face in faces]
    else:
        lines = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property float {a}" for a in "xyz"),
                 f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", *rows,
                 *(f"{len(face)} " + " ".join(map(str, face)) for face in faces)]
    path.write_text("\n".join(lines) + "\n")
    return path, float(0.02 * 0.5 * abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()))


@pytest.mark.parametrize("name", NOTCHED)
@pytest.mark.parametrize("suffix", ["obj", "ply"])
def test_polygons_with_a_notch_keep_it_from_whichever_corner_they_begin(name: str, suffix: str, tmp_path: Path) -> None:
    outline = NOTCHED[name]
    for first in range(len(outline)):
        path, volume = prism(outline[first:] + outline[:first], tmp_path / f"{first}.{suffix}")
        obj = load_object(path)
        assert obj.volume == pytest.approx(volume, rel=1e-5)
        assert trimesh.Trimesh(obj.vertices, obj.faces).area == pytest.approx(_area(outline, volume), rel=1e-5)


def _area(outline: list[tuple[float, float]], volume: float) -> float:
    """Both ends and the sides."""
    ring = 0.02 * np.array(outline)
    return 2 * volume / 0.02 + 0.02 * float(np.linalg.norm(ring - np.roll(ring, 1, 0), axis=1).sum())


def test_notches_are_told_and_whole_faces_are_not(tmp_path: Path) -> None:
    assert "within their outline" in " ".join(load_object(prism(NOTCHED["U"], tmp_path / "u.obj")[0]).notes)
    assert load_object(prism([(0, 0), (3, 0), (4, 2), (2, 3), (0, 2)], tmp_path / "five.obj")[0]).notes == ()


def test_a_sharp_blade_is_no_fold() -> None:
    angle = 0.004  # between its sides [rad]
    ends = [(0.0, 0.0), (0.04, 0.0), (0.04, 0.04 * angle)]
    wedge = trimesh.creation.extrude_triangulation(np.array(ends), np.array([[0, 1, 2]]), 0.1)
    thick = trimesh.creation.box((0.02, 0.02, 0.1)).apply_translation((0.06, 0, 0.05))
    obj = load_object(trimesh.util.concatenate([wedge, thick]))
    assert obj.volume == pytest.approx(0.5 * 0.04**2 * angle * 0.1 + 0.02 * 0.02 * 0.1, rel=1e-6)


def shell(inner: float = 0.044) -> trimesh.Trimesh:
    """A hollow ball with a wall of 1 mm or more."""
    cavity = trimesh.creation.icosphere(3, inner)
    cavity.invert()
    return trimesh.util.concatenate([trimesh.creation.icosphere(3, 0.045), cavity])


def with_a_hole(mesh: trimesh.Trimesh, edges: int) -> trimesh.Trimesh:
    """Without the faces around one vertex of its first body that so many edges surround."""
    valence = np.bincount(mesh.faces.ravel())
    at = int((valence[: len(mesh.vertices) // 2] == edges).nonzero()[0][-1])
    return trimesh.Trimesh(mesh.vertices, mesh.faces[~(mesh.faces == at).any(1)], process=False)


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("edges", [5, 6])
def test_a_small_hole_in_a_thin_wall_changes_nothing_else(edges: int, inverted: bool) -> None:
    whole = shell()
    damaged = with_a_hole(whole, edges)
    assert not damaged.is_watertight
    if inverted:
        damaged.invert()
    obj = load_object(damaged)
    assert obj.volume == pytest.approx(whole.volume, rel=0.02)  # without the cap over the hole
    assert "holes were closed" in obj.notes
    outward = (obj.cloud * obj.cloud_normals).sum(1)
    assert ((outward > 0) == (np.linalg.norm(obj.cloud, axis=1) > 0.0444)).mean() > 0.99


def test_convex_parts_of_a_hollow_thing_with_a_small_hole_leave_it_hollow() -> None:
    box = trimesh.creation.box((0.1, 0.08, 0.06)).subdivide().subdivide()
    inside = trimesh.creation.box((0.09, 0.07, 0.06)).apply_translation((0, 0, 0.006))
    tray = trimesh.boolean.difference([box, inside], engine="manifold").subdivide()
    bottom = np.flatnonzero(tray.vertices[:, 2] < -0.0299)
    at = bottom[np.linalg.norm(tray.vertices[bottom, :2], axis=1).argmin()]
    damaged = trimesh.Trimesh(tray.vertices, tray.faces[~(tray.faces == at).any(1)], process=False)
    obj = load_object(damaged)
    assert obj.volume == pytest.approx(tray.volume, rel=1e-4)
    for vertices, _ in obj.parts:
        assert not trimesh.Trimesh(*_hull(vertices)).contains(np.array([[0.0, 0.0, 0.01]])).any()


def _hull(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    hull = trimesh.convex.convex_hull(vertices)
    return hull.vertices, hull.faces


def test_a_mesh_that_is_inverted_as_a_whole_keeps_its_cavity() -> None:
    whole = shell(0.035)
    inverted = whole.copy()
    inverted.invert()
    assert load_object(inverted).volume == pytest.approx(whole.volume, rel=1e-6)


def test_bodies_within_no_other_are_turned_without_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    winding = igl.fast_winding_number

    def counted(*given: Any) -> Any:
        asked.append(1)
        return winding(*given)

    monkeypatch.setattr(igl, "fast_winding_number", counted)
    bodies = [trimesh.creation.box((0.004, 0.004, 0.004)).apply_translation((0.006 * i, 0.006 * j, 0))
              for i in range(5) for j in range(5)]
    for body in bodies[::3]:
        body.invert()
    obj = load_object(trimesh.util.concatenate(bodies))
    assert obj.volume == pytest.approx(25 * 0.004**3, rel=1e-6)
    assert not asked
