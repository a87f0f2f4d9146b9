"""Which thing of a scene is meant: by a place, a pixel, a mask, or as the nearest; and what is uncertain about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Real
from scipy.spatial import KDTree
from torch import Tensor

from dro_grasp.errors import ObjectError, OptionError
from dro_grasp.geometry.mesh_files import trimesh
from dro_grasp.objects.perception.raised import around, joined_rest, raised
from dro_grasp.objects.perception.segmentation import BACK, NOTHING, OTHER, SPECK, STRUCTURE, Segments
from dro_grasp.objects.perception.things import place_of, size_of
from dro_grasp.objects.reading import numbers, one_channel

Spot = Sequence[float] | Real[np.ndarray, "3"] | Real[Tensor, "3"]  # x, y, z [m]
Pixel = Sequence[float] | Real[np.ndarray, "2"] | Real[Tensor, "2"]  # Column and row, from the upper left
ON = 0.01  # Way from a given place to a point of a thing up to which it lies on that thing [m] (ours)
BESIDE = 0.05  # Longest way from a given place to the thing that is meant [m] (ours)
ASIDE = 12  # Longest way from a given pixel to one with a depth [pixels] (ours)
BORDER = 3  # Pixels from the image's border that touch it (ours)
FULL = 0.3  # Share of a column of the image that has depths beside a thing, unless the camera measures none there [1] (ours)
EDGE = 0.01  # The same of a cloud, as a share of its width [1] (ours)
FAR = 3.0  # Median distance from which the unit of a view without things is doubted [m] (ours)
TOLD = 8  # Things that a message lists (ours)
ON_TABLE = 0.02  # Points of planes nearer to the table than this are its own [m] (ours)
BOARD = 0.006  # Height from which those of another plane are none [m] (ours)
AT_FOOT = 0.03  # Way aside from a thing to what is seen of the plane on which it stands [m] (ours)
PART_OF = 0.025  # Gap to another thing that may be a part of the one that is meant [m] (ours)
LEAST_MASK = 60  # Fewest points in a mask (ours)
MISSED = 1 / 160  # Width of an outline that masks miss, over the image's width [1] (ours): 4 of 640 pixels
SLIVER = 0.1  # Share of a mask's points below which a thing that is mostly beside it is not meant [1] (ours)
COVERED = 0.5  # Share of a plane's points in a mask from which the plane is a face of the object [1] (ours)
SECOND = 0.5  # Share of another thing's points in a mask from which it is told that the thing is left out [1] (ours)
JOINED = 0.015  # Distance of a thing's top from the edge of a level face up to which it ends there [m] (ours)
INSTEAD = {
    STRUCTURE: ("a table, board or wall", "give the object's pixels (mask=PNG)"),
    NOTHING: ("scattered points", "give the object's pixels (mask=PNG), or look from nearer"),
    SPECK: ("something too small", "look from nearer, or give the object's pixels (mask=PNG)"),
    OTHER: ("something too large or far away", "give the object's pixels (mask=PNG): it may hang together with what is around "
            "it; or look from nearer"),
}
"""What a pixel shows that shows no thing, and what to do if the object is there."""
ALONG = 0.5  # Share of its top at such an edge from which it may be a side of a box [1] (ours)


@dataclass(frozen=True, eq=False)
class Sight:
    """The points that a camera saw, or the points of a cloud from all sides."""

    points: Float[np.ndarray, "n 3"]  # in the camera's frame, or in the scene's without a camera [m]
    T: Float[np.ndarray, "4 4"]  # pose of that frame in the scene's [m]
    from_camera: bool  # whether a camera at the origin saw them
    pixels: Int[np.ndarray, " n"]  # index into the flat image or the given rows
    shape: tuple[int, int] | None = None  # height and width of the image, if it was one [pixels]
    intrinsics: Float[np.ndarray, "3 3"] | None = None  # [pixels]

    def world(self) -> Float[np.ndarray, "n 3"]:
        """The points in the scene's frame [m]."""
        return trimesh.transform_points(self.points, self.T)

    def moved(self, T: Float[np.ndarray, "4 4"]) -> Sight:
        """The same in another frame; T takes the scene's coordinates there [m]."""
        return replace(self, T=T @ self.T)

    def of(self, kept: Bool[np.ndarray, " n"]) -> Sight:
        """Some of the points alone."""
        return replace(self, points=self.points[kept], pixels=self.pixels[kept])

    def image(self) -> Float[np.ndarray, "n 2"] | None:
        """Column and row of each point; None where neither an image nor intrinsics tell them."""
        if self.shape is not None:
            return np.stack(np.divmod(self.pixels, self.shape[1])[::-1], 1).astype(float)
        if self.intrinsics is None or not self.from_camera:
            return None
        seen = self.points @ self.intrinsics.T
        return seen[:, :2] / np.maximum(seen[:, 2:], 1e-9)


@dataclass(frozen=True, eq=False)
class Chosen:
    """The points of one object of a scene, and the others."""

    own: Int[np.ndarray, " k"]  # indices of the points of the sight
    others: Int[np.ndarray, " m"]  # those to avoid: all others but scattered ones and the plane on which it stands
    below: int | None  # number of the plane on which it stands
    pixels: Int[np.ndarray, " k"]  # its pixels in the flat image, or its rows of the given cloud
    notes: tuple[str, ...]  # what is uncertain


def choose(
    name: str, sight: Sight, segments: Segments, at: Spot | None, pixel: Pixel | None, mask: Any,
    nearest: bool, part: bool = False,
) -> Chosen:
    """The points of the thing that is meant; see `Scene.object_at`."""
    given = [way for way, said in (("at", at is not None), ("pixel", pixel is not None), ("mask", mask is not None),
                                   ("nearest", nearest)) if said]
    if len(given) > 1:
        raise OptionError(f"{' and '.join(given)} each say which object is meant; give one of them")
    if part and at is None and pixel is None:
        raise OptionError("part asks for one side of things that touch; say by a place (at=(X, Y, Z)) or a pixel "
                          "(pixel=(U, V)) which")
    if mask is not None:
        inside = within(name, sight, mask)
        own, notes, higher = _masked(name, sight, segments, inside)
        return _chosen(sight, segments, own, (*notes, *_left_out(sight, segments, inside, own)), higher)
    if not segments.count:
        raise ObjectError(f"nothing stands out in '{name}': it shows {_planes(segments)} and no thing on it of 4 cm² or more "
                          f"and at most 60 cm; look from nearer, or give the object's pixels (mask=PNG){_far(sight)}")
    side = None
    if at is not None:
        number, side = _at(name, sight, segments, at)
    elif pixel is not None:
        number, side = _at_pixel(name, sight, segments, pixel)
    elif nearest:
        number = _nearest(name, sight, segments)
    elif segments.count == 1:
        number = 0
    else:
        raise ObjectError(f"'{name}' shows {segments.count} things ({listed(sight, segments)}); say which is meant: by a place "
                          "on it (at=(X, Y, Z)), a pixel (pixel=(U, V)), its pixels (mask=PNG), or as the nearest to the "
                          "camera (nearest=True)")
    mine = segments.labels == number
    own = np.flatnonzero(mine & (segments.parts == side) if part else mine)
    notes = (*_touching(segments, number, mine, part), *_beside(sight, segments, own))
    return _chosen(sight, segments, own, notes)


def _far(sight: Sight) -> str:
    """What to do where all is so far away that the unit may be wrong."""
    away = float(np.median(np.linalg.norm(sight.points, axis=1))) if sight.from_camera and len(sight.points) else 0.0
    return "" if away < FAR else (f". Half of what it shows is farther away than {away:.1f} m: if it was nearer, state "
                                  "\"depth_unit\" in the camera's file (0.0001 for tenths of a millimetre), or give a scale")


def _touching(segments: Segments, number: int, mine: Bool[np.ndarray, " n"], part: bool) -> tuple[str, ...]:
    """A note where what counts as one thing may be two."""
    divided = bool(segments.parts[mine].any())
    if part:
        return () if divided else ("no side of it stands by itself, so all of it counts. If that is too much, give the pixels "
                                   "of what is meant (mask=PNG)",)
    if not segments.seams[number]:
        return ()
    if divided:
        return ("it may be two things that touch: its surface turns inward along a seam, or breaks off at a gap, and both "
                "sides count as one. If so, mean the side that you point at (part=True), or give its pixels (mask=PNG)",)
    return ("it may be two things that touch, one on the other or in it: its surface turns inward along a seam, or breaks off "
            "at a gap, and both count as one. If so, give the pixels of the one that you mean (mask=PNG)",)


def _beside(sight: Sight, segments: Segments, own: Int[np.ndarray, " k"]) -> tuple[str, ...]:
    """A note where another thing is so near that it may be a part of this one, which hides the part between."""
    others = segments.labels >= 0
    others[own] = False
    if not others.any():
        return ()
    own = own[:: max(1, len(own) // 4000)]
    other = np.flatnonzero(others)
    other = other[:: max(1, len(other) // 20000)]
    away = float(KDTree(sight.points[other]).query(sight.points[own])[0].min())
    return (f"another thing, {1000 * away:.0f} mm beside it, counts as an obstacle. If it is a part of this one, give the "
            "pixels of both (mask=PNG)",) if away < PART_OF else ()


def listed(sight: Sight, segments: Segments) -> str:
    """The things of a scene in words, with their sizes and places [the scene's frame]."""
    world = sight.world()
    told = []
    for number in range(min(segments.count, TOLD)):
        points = world[segments.labels == number]
        told.append(f"{size_of(points)} at {place_of(points)}")
    return "; ".join(told) + ("; ..." if segments.count > TOLD else "") or "no thing that stands out"


def _planes(segments: Segments) -> str:
    areas = [f"{area:.2g} m²" for area in segments.areas]
    return f"{len(areas)} {'plane' if len(areas) == 1 else 'planes'} ({', '.join(areas)})" if areas else "no plane"


def _at(name: str, sight: Sight, segments: Segments, at: Spot) -> tuple[int, int]:
    """The thing at a place, and which part of it is nearest to the place."""
    place = numbers(at, "at").astype(np.float64)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise OptionError(f"at is {place.tolist()}; give x, y and z in metres")
    world, labels = sight.world(), segments.labels
    things = np.flatnonzero(labels >= 0)
    away = np.linalg.norm(world[things] - place, axis=1)
    closest = int(away.argmin())
    # A place may lie within a thing, of which a camera sees only the near side.
    within = None if away[closest] < ON else _inside(world, labels, place, segments.count)
    if away[closest] > BESIDE and within is None:
        raise ObjectError(f"'{name}' shows no thing within {100 * BESIDE:.0f} cm of {place_of(place[None])}: the nearest is "
                          f"{100 * away[closest]:.0f} cm away. It shows {listed(sight, segments)}")
    number = int(labels[things[closest]]) if within is None else within
    own = np.flatnonzero(labels == number)
    return number, int(segments.parts[own[np.linalg.norm(world[own] - place, axis=1).argmin()]])


def _inside(
    world: Float[np.ndarray, "n 3"], labels: Int[np.ndarray, " n"], place: Float[np.ndarray, "3"], count: int
) -> int | None:
    """The thing in whose box a place lies; the one with the smallest box of several."""
    found = []
    for number in range(count):
        points = world[labels == number]
        low, high = points.min(0), points.max(0)
        if ((place >= low) & (place <= high)).all():
            found.append((float(np.prod(high - low)), number))
    return min(found)[1] if found else None


def _at_pixel(name: str, sight: Sight, segments: Segments, pixel: Pixel) -> tuple[int, int]:
    """The thing that a pixel shows, and which part of it."""
    image, wanted = sight.image(), numbers(pixel, "pixel").astype(np.float64)
    if image is None:
        raise OptionError(f"a pixel is given, and '{name}' is a cloud without an image; state \"intrinsics\" in the camera's "
                          "file, or give a place (at=(X, Y, Z))")
    if wanted.shape != (2,) or not np.isfinite(wanted).all():
        raise OptionError(f"pixel is {wanted.tolist()}; give its column and row")
    if sight.shape is not None and not ((wanted >= 0) & (wanted < sight.shape[::-1])).all():
        raise OptionError(f"pixel is {wanted[0]:g} {wanted[1]:g}, beside the image of {sight.shape[1]} x {sight.shape[0]}; "
                          "give its column and row, from the upper left")
    away = np.linalg.norm(image - wanted, axis=1)
    closest = int(away.argmin())
    if away[closest] > ASIDE:
        raise ObjectError(f"no pixel within {ASIDE} of {wanted[0]:g} {wanted[1]:g} has a depth; give one that has, or the "
                          f"object's pixels (mask=PNG). '{name}' shows {listed(sight, segments)}")
    number = int(segments.labels[closest])
    if number < 0:
        what, instead = INSTEAD.get(number, INSTEAD[OTHER])
        raise ObjectError(f"the pixel {wanted[0]:g} {wanted[1]:g} shows {what}. If the object is there, {instead}. '{name}' "
                          f"shows {listed(sight, segments)}")
    return number, int(segments.parts[closest])


def _nearest(name: str, sight: Sight, segments: Segments) -> int:
    if not sight.from_camera:
        raise OptionError(f"nearest asks for the camera's place, and '{name}' has none; give the camera, or a place "
                          "(at=(X, Y, Z))")
    away = np.linalg.norm(sight.points, axis=1)
    return int(np.argmin([np.quantile(away[segments.labels == k], 0.05) for k in range(segments.count)]))


def within(name: str, sight: Sight, mask: Any) -> Bool[np.ndarray, " n"]:
    """Which points of a sight a mask is true on.

    Raises:
        ObjectError: The mask has another size than the image.
        OptionError: The sight has no image.
    """
    from dro_grasp.objects.perception.scene_files import read_mask

    if sight.shape is None:
        raise OptionError(f"a mask is given, and '{name}' is a cloud without an image; give the depth image, an organised "
                          "cloud (h, w, 3), or a place (at=(X, Y, Z))")
    wanted = read_mask(Path(mask)) if isinstance(mask, str | Path) else (
        np.nan_to_num(one_channel(numbers(mask, "the mask", "biuf"))) != 0)
    if wanted.shape != sight.shape:
        which = f"the mask {mask}" if isinstance(mask, str | Path) else "the mask"
        raise ObjectError(f"{which} has shape {wanted.shape}, and what the camera saw, '{name}', has {sight.shape}: rows and "
                          "columns of its image; give a mask with one value for each pixel of that image")
    return np.asarray(wanted.ravel()[sight.pixels])


def all_within(name: str, sight: Sight, segments: Segments, mask: Any) -> Chosen:
    """All points that a mask is true on, whatever they were taken for; errors are those of `within`."""
    return _chosen(sight, segments, np.flatnonzero(within(name, sight, mask)), ())


def _masked(
    name: str, sight: Sight, segments: Segments, inside: Bool[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " k"], tuple[str, ...], bool]:
    """The points of the object that a mask shows, what to say of them, and whether they are of no thing that stands out."""
    plane = _plane_of(sight, segments)
    own = _standing_out(sight, segments, plane, inside)
    faces, rest = raised(sight, segments, plane, inside)
    parts, whole = (np.bincount(segments.labels[(segments.labels >= 0) & rows], minlength=max(1, segments.count))
                    for rows in (inside, np.ones(len(inside), bool)))
    most = int(parts.argmax())
    if (parts <= COVERED * whole).all():  # no thing is in the mask for the most part
        instead = joined_rest(sight.points, faces, rest)
        new = LEAST_MASK if not parts.any() else 1  # without a thing, what is on no plane counts in any case
        if (len(instead) >= max(LEAST_MASK, parts[most] + 1, SLIVER * inside.sum())
                and len(np.setdiff1d(instead, own)) >= new):
            return instead, (_raised_note(segments, instead),), True
        if len(own) >= LEAST_MASK and 0 < parts[most] < SLIVER * inside.sum():
            place = place_of(sight.world()[segments.labels == most])
            raise ObjectError(f"the mask lies beside what stands out: {parts[most]} of its {inside.sum()} points are on a "
                              f"thing, and of this one, at {place}, most is beside the mask ({parts[most]} of {whole[most]} "
                              "points are in it). All others are on tables, walls, or what is too large to be meant; give a "
                              f"mask that is true on all that is seen of the object. '{name}' shows {listed(sight, segments)}")
    if len(own) < LEAST_MASK:
        flat = "" if inside.sum() < LEAST_MASK else (
            " (what lies too flat to stand out is taken from a robot's table only, by pick_object or `dro-grasp plan --mask`)")
        raise ObjectError(f"the mask has {len(own)} points that stand out of tables and walls, and at least {LEAST_MASK} are "
                          f"needed; give one that is true on the object{flat}. '{name}' shows {listed(sight, segments)}")
    return own, _higher_note(np.setdiff1d(np.flatnonzero(faces), own), own), False


def _raised_note(segments: Segments, own: Int[np.ndarray, " k"]) -> str:
    on = int((segments.labels[own] == STRUCTURE).sum())
    return ("no thing that stands out by itself is in the mask for the most part, so what the mask shows that is higher than "
            f"its surroundings counts: {len(own)} points, {on} of them on what looks like a table, a board or a wall. If that "
            "is not the object, give a mask that is true on all of the object, and on nothing else")


def _higher_note(faces: Int[np.ndarray, " m"], own: Int[np.ndarray, " k"]) -> tuple[str, ...]:
    """A note where most of what a mask shows is a raised face that counts as a board."""
    return (f"the mask also shows a face that is higher than its surroundings and looks like a board or a wall ({len(faces)} "
            f"points), which is an obstacle: {len(own)} points count as the object. If the face is a part of it, give a mask "
            "that is true on the object, and on nothing else",) if len(faces) > len(own) else ()


def _standing_out(
    sight: Sight, segments: Segments, plane: Int[np.ndarray, " n"], inside: Bool[np.ndarray, " n"]
) -> Int[np.ndarray, " k"]:
    """What stands out of tables and walls inside a mask, without what is behind the thing of which most is inside."""
    faces = _faces(sight, segments, plane, inside)
    own = np.flatnonzero(inside & ((plane < 0) | faces[plane]))
    # Masks reach over an object's outline: of what is behind it, the part with fewer points is left out.
    labels = segments.labels[own]
    if (labels >= 0).any():
        most = np.bincount(labels[labels >= 0]).argmax()
        near = KDTree(sight.points[own[labels == most]]).query(sight.points[own])[0] < BESIDE
        beside = np.bincount(plane[own[near & (labels == STRUCTURE)]], minlength=len(faces)) > 0
        own = own[near | ((labels == STRUCTURE) & beside[plane[own]])]
    return own


def _plane_of(sight: Sight, segments: Segments) -> Int[np.ndarray, " n"]:
    """The plane of each point of a table, board or wall; -1 for all others."""
    number = np.full(len(segments.labels), -1)
    rows = np.flatnonzero(segments.labels == STRUCTURE)
    if len(rows) and segments.planes:
        planes = np.array(segments.planes)
        number[rows] = np.abs(sight.points[rows] @ planes[:, :3].T - planes[:, 3]).argmin(1)
    return number


def _faces(
    sight: Sight, segments: Segments, plane: Int[np.ndarray, " n"], inside: Bool[np.ndarray, " n"]
) -> Bool[np.ndarray, " p"]:
    """Which planes are faces of an object that is inside a mask, and no tables or walls.

    They are within the mask for the most part. A level one has another below it, which is not; an upright one stands on such a
    plane.
    """
    planes, covered = segments.planes, _covered(segments, plane, inside)
    faces = np.zeros(len(planes) + 1, bool)  # the last for points of no plane
    for k in np.flatnonzero(covered):
        middle = sight.points[plane == k].mean(0)
        for j in np.flatnonzero(~covered):
            cosine, height = float(planes[j][:3] @ planes[k][:3]), float(planes[j][:3] @ middle - planes[j][3])
            faces[k] |= height > ON_TABLE and (cosine > 0.9 or abs(cosine) < 0.2)
    return faces


def _covered(
    segments: Segments, plane: Int[np.ndarray, " n"], inside: Bool[np.ndarray, " n"]
) -> Bool[np.ndarray, " p"]:
    """Which planes are inside for the most part."""
    count = len(segments.planes)
    whole, part = (np.bincount(plane[(plane >= 0) & rows], minlength=count) for rows in (np.ones(len(plane), bool), inside))
    return part > COVERED * whole


def _left_out(
    sight: Sight, segments: Segments, inside: Bool[np.ndarray, " n"], own: Int[np.ndarray, " k"]
) -> tuple[str, ...]:
    """A note on other things that a mask shows as well."""
    left = inside.copy()
    left[own] = False
    things = segments.labels >= 0
    left = np.bincount(segments.labels[left & things], minlength=segments.count)
    told = np.flatnonzero(left > SECOND * np.bincount(segments.labels[things], minlength=segments.count))
    if not len(told):
        return ()
    world = sight.world()
    places = "; ".join(place_of(world[segments.labels == k]) for k in told[:TOLD])
    return (f"the mask shows more than one thing: the largest counts, and what is at {places} is an obstacle. Give "
            "a mask for each object",)


def _side_of_box(sight: Sight, segments: Segments, own: Int[np.ndarray, " k"], below: int) -> tuple[str, ...]:
    """A note where a thing ends at a level face, which counts as a table: it may be one side of a large box."""
    up = segments.planes[below][:3]
    boards = segments.labels == STRUCTURE
    boards[own] = False
    for k, plane in enumerate(segments.planes):
        if k == below or plane[:3] @ up < 0.97:
            continue
        # What is just below the face counts as the edge of its board.
        height = sight.points @ plane[:3] - plane[3]
        edge = np.flatnonzero(boards & (height > -BACK - JOINED) & (height < JOINED))
        top = float(np.quantile(height[own], 0.98))
        if len(edge) and -BACK - JOINED < top < JOINED:
            ends = own[height[own] > top - JOINED]
            if float((KDTree(sight.points[edge]).query(sight.points[ends])[0] < JOINED).mean()) > ALONG:
                return ("it ends at a level face that counts as a table of its own, so it may be one side of a large box, and "
                        "not all of it. If so, give the pixels of all of the box (mask=PNG)",)
    return ()


def _chosen(
    sight: Sight, segments: Segments, own: Int[np.ndarray, " k"], notes: tuple[str, ...], higher: bool = False
) -> Chosen:
    """What is chosen with these points, and what is uncertain; those that are raised stand on no plane on which they lie."""
    labels, taken = segments.labels, np.zeros(len(sight.points), bool)
    taken[own] = True
    planes = _plane_of(sight, segments)
    below = _below(sight, segments, own, planes, higher)
    avoided = (labels != NOTHING) & ~taken & ~_outline(sight, segments, taken, planes)
    # Specks beside a thing are parts of it that the camera saw badly, or what it scatters at its outline.
    specks = np.flatnonzero(labels == SPECK)
    if len(specks):
        avoided[specks[KDTree(sight.points[own]).query(sight.points[specks])[0] < BESIDE]] = False
    if below is not None:
        plane = segments.planes[below]
        # Hands stay above the table by another way, and not above a thin board that lies on it.
        board = (planes >= 0) & (planes != below)
        height = sight.points @ plane[:3] - plane[3]
        avoided &= (labels >= 0) | (np.abs(height) > ON_TABLE) | (board & (height > BOARD))
        notes = (*notes, *_side_of_box(sight, segments, own, below))
    return Chosen(own, np.flatnonzero(avoided), below, sight.pixels[own], (*notes, *_cut_off(sight, own)))


def _outline(
    sight: Sight, segments: Segments, taken: Bool[np.ndarray, " n"], planes: Int[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Which points are just beside those that are taken, and on what the object is made of: masks end before it does.

    Such are the part of a thing, or the plane, that has most of the points, and those of which most is taken.
    """
    if sight.shape is None:
        return np.zeros(len(taken), bool)
    sides = int(segments.parts.max(initial=0)) + 1
    kind = np.where(planes < 0, (segments.labels - SPECK) * sides + segments.parts, (segments.count - SPECK) * sides + planes)
    count = int(kind.max()) + 1
    whole, part = np.bincount(kind, minlength=count), np.bincount(kind[taken], minlength=count)
    mine = part > COVERED * whole
    mine[part.argmax()] = True
    return around(sight, taken, MISSED) & mine[kind]


def _below(
    sight: Sight, segments: Segments, own: Int[np.ndarray, " k"], planes: Int[np.ndarray, " n"], higher: bool
) -> int | None:
    """The plane on which a thing stands: of those that are seen beside it, else of all, the nearest to its lowest points.

    It is as level as the largest that can be one. A plane that is a face of the thing is none; of what is raised, each plane
    on which some of it lies.
    """
    if not segments.planes:
        return None
    points, mine = sight.points[own], np.zeros(len(sight.points), bool)
    mine[own] = True
    faces = _covered(segments, planes, mine)
    if higher:
        faces |= np.bincount(planes[mine & (planes >= 0)], minlength=len(faces)) > 0
    normals = np.array([plane[:3] for plane in segments.planes])
    up = normals[0]
    if sight.from_camera and (level := np.abs(sight.T[2, :3] @ normals.T) > 0.9).any():
        up = normals[level.argmax()]
    # The lowest points, less those that noise puts lower (ours).
    lows = [float(np.quantile(points @ plane[:3] - plane[3], 0.02)) for plane in segments.planes]
    fits = [i for i, low in enumerate(lows) if normals[i] @ up > 0.9 and low > -0.02 and not faces[i]]
    flat = np.linalg.svd(up[None])[2][1:]
    own_foot = KDTree(_some(points) @ flat.T)
    beside = [i for i in fits if (seen := planes == i).any()
              and own_foot.query(_some(sight.points[seen]) @ flat.T)[0].min() < AT_FOOT]
    return min(beside or fits, key=lambda i: abs(lows[i]), default=None)


def _some(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Every few of many points."""
    return points[:: max(1, len(points) // 8000)]


CLOUD_EDGE = "the cloud's edge"  # Where a cloud without an image ends
CUT_OFF = "it reaches {} and may be cut off there"
"""What is said of a thing at the border of the image, or at the cloud's edge."""


def _cut_off(sight: Sight, own: Int[np.ndarray, " k"]) -> tuple[str, ...]:
    """A note where a thing reaches the border of the image, or of the cloud."""
    image = sight.image() if sight.shape is not None else None
    if image is not None and sight.shape is not None:
        low, high = image[own].min(0), image[own].max(0)
        size = np.array(sight.shape[::-1]) - 1
        cut, what = bool((low < BORDER).any() or (high > size - BORDER).any()), "the image's border"
        # Stereo cameras measure no depth in a band along one side, where all else ends as well.
        others = np.bincount(np.delete(image[:, 0], own).astype(int), minlength=sight.shape[1])
        full = np.flatnonzero(others > FULL * sight.shape[0])
        if not cut and len(full):
            cut, what = bool(low[0] < full[0] + BORDER or high[0] > full[-1] - BORDER), "where the image's depths end"
    else:
        flat = sight.points[:, :2] / np.maximum(sight.points[:, 2:], 1e-9) if sight.from_camera else sight.points[:, :2]
        margin = EDGE * np.ptp(flat, axis=0)
        cut = bool((flat[own].min(0) < flat.min(0) + margin).any() or (flat[own].max(0) > flat.max(0) - margin).any())
        what = CLOUD_EDGE
    return (f"{CUT_OFF.format(what)}: grasps know nothing of the rest. Turn the camera so that all of it "
            "is seen",) if cut else ()
