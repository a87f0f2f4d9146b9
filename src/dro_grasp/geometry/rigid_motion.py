"""Rigid motions in files."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import OptionError


def read_motion(path: Path, key: str) -> tuple[str, Float[Tensor, "4 4"]]:
    """A frame's name and a matrix from a JSON file `{"frame": NAME, key: 4x4}`.

    Args:
        path: The file.
        key: What the matrix is called, as `T_frame_object`.

    Raises:
        OptionError: No such file, no such content, or no rigid motion.
    """
    wanted = f'{path} must hold {{"frame": NAME, "{key}": [4 rows of 4 numbers]}}, in metres'
    try:
        values = json.loads(path.read_text())
        name, T = str(values["frame"]), torch.tensor(values[key], dtype=torch.float64)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise OptionError(f"{wanted}; it does not ({error})") from error
    if T.shape != (4, 4) or not bool(T.isfinite().all()) or T[3].tolist() != [0, 0, 0, 1]:
        raise OptionError(f"{wanted}; its matrix has shape {tuple(T.shape)} or a last row other than 0 0 0 1")
    R = T[:3, :3]
    if float((R @ R.T - torch.eye(3)).abs().max()) > 1e-3 or float(torch.linalg.det(R)) < 0:
        raise OptionError(f"{wanted}; the upper left 3x3 of its matrix is no rotation (scaled, or mirrored)")
    return name, T.float()
