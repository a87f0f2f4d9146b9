"""Faces within outlines: of polygons with a notch, which readers cut into fans, and of small holes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from dro_grasp.geometry.mesh_files import trimesh

FOLD = 2e-3  # Angle up to which two faces lie on one another [rad] (ours): coordinates of files are rounded
FLAT = 1e-4  # Distance from a plane up to which a vertex lies in it, over the mesh's largest extent [1] (ours)
MOST = 64  # Folds that are of no polygon before no more are looked at (ours): crumpled scans have thousands
LEAST = 1e-3  # Area that is folded, over that of the mesh, from which on it is cut anew [1] (ours): scans have small folds
BESIDE = 32  # Most faces around some without area that are compared with each other (ours)
EXACT = 1e-3  # Share of an outline's area by which the area of the faces within it may differ [1] (ours)

Faces = Int[np.ndarray, "n 3"]
Loop = list[int]  # Vertices of an outline, one after the other


def unfold(mesh: trimesh.Trimesh) -> int:
    """Cut flat faces with a notch within their outline, in place; returns how many there were.

    Readers cut a polygon of a file into triangles from one corner. Where it has a notch, some of these lie folded over others,
    and the surface closes the notch. The outline of such triangles is the polygon's.
    """
    # Of its own: normals that a mesh keeps are not turned with it.
    areas = _areas(mesh.triangles)
    size = np.linalg.norm(areas, axis=1)
    folded = _folded_pairs(mesh, areas / np.maximum(size, 1e-300)[:, None])
    if not len(folded):
        return 0
    faces, vertices = np.asarray(mesh.faces), np.asarray(mesh.vertices)
    dropped, added, count, others = np.zeros(len(faces), bool), list[Faces](), 0, 0
    for pair in folded:
        if others == MOST:
            break
        if dropped[pair].any():
            continue
        larger = pair[size[pair].argmax()]
        height = np.abs((vertices - vertices[faces[larger, 0]]) @ (areas[larger] / size[larger]))
        flat = (height[faces] < FLAT * mesh.extents.max()).all(1) & ~dropped
        pieces = trimesh.graph.connected_component_labels(
            mesh.face_adjacency[flat[mesh.face_adjacency].all(1)], node_count=len(faces))
        group = (pieces == pieces[larger]).nonzero()[0]
        outlines, whole = _loops(_border(faces[group]))
        within = _within(vertices, outlines) if whole else faces[:0]
        area = np.linalg.norm(areas[group].sum(0))  # what is folded counts against the rest
        if size[group].sum() - area > LEAST * size.sum() and abs(_size(vertices[within]) - area) < EXACT * area:
            dropped[group], count = True, count + 1
            added.append(within)
        else:
            others += 1
    if count:
        mesh.faces = np.concatenate([faces[~dropped], *added])
        mesh.remove_unreferenced_vertices()
    return count


def _folded_pairs(mesh: trimesh.Trimesh, normals: Float[np.ndarray, "m 3"]) -> Int[np.ndarray, "n 2"]:
    """Neighbours with opposite unit normals, which may have faces without area between them."""
    empty = ~mesh.nondegenerate_faces()
    pairs = mesh.face_adjacency
    if empty.any():
        between = pairs[empty[pairs].any(1)]
        pieces = trimesh.graph.connected_component_labels(between[empty[between].all(1)], node_count=len(mesh.faces))
        beside = {(int(pieces[e]), int(f)) for pair in between for e, f in (pair, pair[::-1]) if empty[e] and not empty[f]}
        around: dict[int, list[int]] = {}
        for piece, face in sorted(beside):
            around.setdefault(piece, []).append(face)
        further = [pair for faces in around.values() if len(faces) <= BESIDE for pair in combinations(faces, 2)]
        pairs = np.concatenate([pairs[~empty[pairs].any(1)], np.array(further, int).reshape(-1, 2)])
    return pairs[np.einsum("ni,ni->n", normals[pairs[:, 0]], normals[pairs[:, 1]]) < -np.cos(FOLD)]


def close_small_holes(mesh: trimesh.Trimesh, largest: float) -> None:
    """Close holes of a mesh that is wound alike, in place, by faces after all others.

    `largest` is the largest area of a hole, over that of the connected piece around it.
    """
    faces, vertices = np.asarray(mesh.faces), np.asarray(mesh.vertices)
    pieces = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(faces))
    area = np.bincount(pieces, mesh.area_faces)
    piece_of = np.zeros(len(vertices), int)
    piece_of[faces] = pieces[:, None]
    found, added = _loops(_border(faces)[:, ::-1])[0], list[Faces]()
    for loop in found:
        within = _within(vertices, [loop])
        if len(within) and _size(vertices[within]) <= largest * area[piece_of[loop[0]]]:
            added.append(within)
    if added:
        mesh.faces = np.concatenate([faces, *added])


def _border(faces: Faces) -> Int[np.ndarray, "m 2"]:
    """Edges of faces that no other face has the other way round, in their direction."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    count = Counter(map(tuple, edges.tolist()))
    left = [edge for edge, times in count.items() if times > count[edge[::-1]]]
    return np.array(left, int).reshape(-1, 2)


def _loops(edges: Int[np.ndarray, "m 2"]) -> tuple[list[Loop], bool]:
    """Vertices of directed edges, one closed loop after the other; and whether every edge is in one that crosses no other."""
    times = np.bincount(edges.ravel(), minlength=1)
    after = {a: b for a, b in edges.tolist() if times[a] == times[b] == 2}
    found, whole = list[Loop](), len(after) == len(edges)
    while after:
        loop = [next(iter(after))]
        while (vertex := after.pop(loop[-1], None)) is not None and vertex != loop[0]:
            loop.append(vertex)
        if vertex is None:
            whole = False
        else:
            found.append(loop)
    return found, whole


def _within(vertices: Float[np.ndarray, "m 3"], outlines: Sequence[Loop]) -> Faces:
    """Triangles within outlines, seen along the normal of what they enclose, from where they lead counter-clockwise."""
    import manifold3d

    normal = np.sum([np.cross(vertices[loop], np.roll(vertices[loop], -1, axis=0)).sum(0) for loop in outlines], axis=0)
    length = float(np.linalg.norm(normal))
    if length == 0:
        return np.zeros((0, 3), int)
    # Two directions across the normal, which with it are right-handed.
    across = np.linalg.svd(np.atleast_2d(normal / length))[2][1:]
    across[1] *= np.sign(np.linalg.det(np.stack([*across, normal / length])))
    flat = [np.ascontiguousarray(vertices[loop] @ across.T) for loop in outlines]
    order = np.concatenate([np.asarray(loop) for loop in outlines])
    return order[np.asarray(manifold3d.triangulate(flat, allow_convex=False))]


def _areas(triangles: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """Area times normal, of each."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]) / 2


def _size(triangles: Float[np.ndarray, "n 3 3"]) -> float:
    """Area of all."""
    return float(np.linalg.norm(_areas(triangles), axis=1).sum())
