"""What of a mask is raised over its surroundings, though it counted as a table, a board or a wall, or as too large."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import KDTree

from dro_grasp.objects.perception.segmentation import LONGEST_THING, STRUCTURE, Segments

if TYPE_CHECKING:
    from dro_grasp.objects.perception.choosing import Sight

RING = 0.04  # Width of the ring around a mask that is its surroundings, over the image's width [1] (ours)
LOWER = 0.25  # Share of the ring's points that are lower than a face that is raised [1] (ours)
OVER = 0.02  # Height from which something is raised [m] (ours): what is lower may be the surface below it
WHOLE = 0.5  # Share of a connected piece of a plane in a mask from which the piece is meant [1] (ours): of a table it is less
GROUND = 0.1  # Quantile of heights in and around a mask that is the ground's [1] (ours)
AROUND = 0.3  # Distance from the middle of a mask up to which that counts [m] (ours)
CLOSED = 2  # Pixels by which the pieces of a plane are closed (ours): gaps without a depth divide none
REST = 0.05  # Way from what is meant to the rest of it [m] (ours)


def raised(
    sight: Sight, segments: Segments, plane: Int[np.ndarray, " n"], inside: Bool[np.ndarray, " n"]
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Which points in a mask are raised and of no thing: those on planes, of which `plane` has the numbers, and all others.

    On a plane, the connected piece is in the mask for the most part, and a part of what surrounds the mask is lower. Of what is
    on no plane, what is as low as the ground around the mask is left out, and what is far from the mask's middle.
    """
    assert sight.shape is not None
    ring = around(sight, inside, RING)
    faces = np.zeros(len(inside), bool)
    for k in np.unique(plane[inside & (plane >= 0)]):
        height = sight.points[ring] @ segments.planes[k][:3] - segments.planes[k][3]
        if len(height) and float((height < -OVER).mean()) > LOWER:
            faces |= _whole_pieces(sight, plane == k, inside)
    if faces.any() and np.ptp(sight.points[faces], axis=0).max() > LONGEST_THING:
        faces[:] = False
    rest = inside & (segments.labels < 0) & (segments.labels != STRUCTURE)
    return faces, rest & _over_ground(sight, segments, inside, ring)


def around(sight: Sight, inside: Bool[np.ndarray, " n"], wide: float) -> Bool[np.ndarray, " n"]:
    """Which points surround others in the image, up to a share of its width."""
    assert sight.shape is not None
    mask = np.zeros(sight.shape, bool)
    mask.ravel()[sight.pixels[inside]] = True
    grown = ndimage.binary_dilation(mask, np.ones((3, 3)), iterations=max(1, round(wide * sight.shape[1])))
    return np.asarray(grown).ravel()[sight.pixels] & ~inside


def joined_rest(
    points: Float[np.ndarray, "n 3"], faces: Bool[np.ndarray, " n"], rest: Bool[np.ndarray, " n"]
) -> Int[np.ndarray, " k"]:
    """Indices of both, the rest only where it is beside the faces, unless it is more than they are."""
    own = np.flatnonzero(faces | rest)
    if faces.sum() < rest.sum():
        return own
    return own[KDTree(points[faces]).query(points[own])[0] < REST] if faces.any() else own


def _whole_pieces(sight: Sight, own: Bool[np.ndarray, " n"], inside: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """The points in a mask of those connected pieces of a plane's points that are in it for the most part."""
    assert sight.shape is not None
    image = np.zeros(sight.shape, bool)
    image.ravel()[sight.pixels[own]] = True
    closed = ndimage.binary_closing(np.pad(image, CLOSED + 1), iterations=CLOSED)
    pieces, count = ndimage.label(closed, np.ones((3, 3)))  # type: ignore
    pieces = pieces[CLOSED + 1:-CLOSED - 1, CLOSED + 1:-CLOSED - 1]
    piece = np.where(own, pieces.ravel()[sight.pixels], 0)
    whole, part = (np.bincount(piece[rows], minlength=count + 1) for rows in (own, own & inside))
    return inside & (piece > 0) & (part > WHOLE * whole)[piece]


def _over_ground(
    sight: Sight, segments: Segments, inside: Bool[np.ndarray, " n"], ring: Bool[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Which points are near the middle of a mask, and higher than the ground in it and around it."""
    if not inside.any():
        return inside
    near = np.linalg.norm(sight.points - np.median(sight.points[inside], axis=0), axis=1) < AROUND
    height = sight.points @ _up(sight, segments)
    here = near & (inside | ring)
    return near & (height > np.quantile(height[here], GROUND) + OVER) if here.any() else near


def _up(sight: Sight, segments: Segments) -> Float[np.ndarray, "3"]:
    """The way up in the camera's frame: the scene's z where the camera looks down in it, else away from the largest plane."""
    if sight.from_camera and sight.T[2, 2] < 0:
        return sight.T[2, :3]
    return segments.planes[0][:3] if segments.planes else np.array([0.0, 0.0, -1.0])
