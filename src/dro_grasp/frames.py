"""Frames: the names of their half-axes, and their poses in JSON files."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.files import FRAME_FILE, given_path, require_known

HALF_AXES = ("+x", "-x", "+y", "-y", "+z", "-z")  # Names of the half-axes, in the order of the indices of `half_axis`
ROUNDING = 1e-3  # Largest deviation of a rotation's product with its transpose from the identity (ours)
LAST_ROW = 1e-6  # Largest deviation of the last row from 0 0 0 1 (ours): products of matrices round
LONGEST_TRANSLATION = 100.0  # A longer translation must be in another unit [m] (ours)


def half_axis(directions: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
    """Index into HALF_AXES of the half-axis nearest to each direction."""
    axis = directions.abs().argmax(-1)
    return 2 * axis + (directions.gather(1, axis[:, None])[:, 0] < 0)


def half_axis_direction(name: str) -> tuple[float, float, float]:
    """The unit vector along one of HALF_AXES."""
    sign = 1.0 if name[0] == "+" else -1.0
    x, y, z = (sign if letter == name[1] else 0.0 for letter in "xyz")
    return x, y, z


class NamedMotion(NamedTuple):
    """A pose in a named frame."""

    frame: str
    T: Float[Tensor, "4 4"]  # takes coordinates to those of the frame [m]


def read_motion(path: Path, key: str) -> NamedMotion:
    """A frame's name and a matrix from a JSON file `{"frame": NAME, key: 4x4}`, with a key such as `T_frame_object`.

    One file may hold the poses of camera and object, and the camera's intrinsics and unit of depths. OptionError: it holds
    something else.
    """
    path = given_path(path)
    wanted = f'{path} must hold {{"frame": NAME, "{key}": [4 rows of 4 numbers]}}, in metres'
    if not os.path.isfile(path):  # nothing is read from devices and pipes
        raise OptionError(f"{wanted}; there is no such file")
    try:
        values = json.loads(path.read_text())
        name, T = values["frame"], torch.tensor(values[key], dtype=torch.float64)
    except KeyError as error:
        raise OptionError(f"{wanted}; it has no entry {error}") from error
    except (OSError, ValueError, TypeError, LookupError, ArithmeticError, RuntimeError) as error:
        raise OptionError(f"{wanted}; it does not ({error})") from error
    require_known(values, FRAME_FILE, path)
    if not is_name(name):
        raise OptionError(f"{wanted}; its frame is {name!r}, which is not a name on one line")
    if (fault := motion_fault(T)) is not None:
        raise OptionError(f"{wanted}; {fault}")
    T[3] = T.new_tensor([0, 0, 0, 1])
    return NamedMotion(name, T.float())


def is_name(name: object) -> bool:
    """Whether it may name a frame: files of robots have names on one line, without control characters."""
    return isinstance(name, str) and bool(name.strip()) and name.isprintable()


def are_rotations(R: Float[Tensor, "*b 3 3"]) -> Bool[Tensor, "*b"]:
    """Which matrices are rotations, up to ROUNDING."""
    apart = (R @ R.mT - torch.eye(3, dtype=R.dtype, device=R.device)).abs().amax((-1, -2))
    return (apart <= ROUNDING) & (torch.linalg.det(R) > 0)


def motion_fault(T: Float[Tensor, "*any"]) -> str | None:
    """Why a matrix is no rigid motion in metres, in words; None if it is one."""
    if not bool(T.isfinite().all()):
        return "its matrix holds NaN or infinity"
    if T.shape != (4, 4) or not bool((T[3] - T.new_tensor([0, 0, 0, 1])).abs().max() <= LAST_ROW):
        return f"its matrix has shape {tuple(T.shape)} or a last row other than 0 0 0 1"
    if not bool(are_rotations(T[:3, :3])):
        return "the upper left 3x3 of its matrix is not a rotation (scaled, or mirrored)"
    if float(T[:3, 3].norm()) > LONGEST_TRANSLATION:
        return f"its translation is {float(T[:3, 3].norm()):g} m long; divide millimetres by 1000"
    return None
