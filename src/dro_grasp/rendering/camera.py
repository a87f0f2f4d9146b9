"""The camera of a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Num

from dro_grasp.rendering.meshes import unit

NEAR = 1e-3
"""Triangles closer to the camera than this are not drawn [m] (ours)."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera."""

    position: tuple[float, float, float]
    """Optical centre [m]."""
    target: tuple[float, float, float]
    """The point in the middle of the picture [m]."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction that points up in the picture."""
    field_of_view: float = 0.6
    """Angle between the upper and lower edges [rad]."""

    @staticmethod
    def around(
        points: Num[np.ndarray, "n 3"], direction: tuple[float, float, float], up: tuple[float, float, float] = (0.0, 0.0, 1.0),
        field_of_view: float = 0.6, aspect: float = 4 / 3, margin: float = 0.06,
    ) -> Camera:
        """The nearest camera in a direction that has all points in its picture.

        Args:
            direction: From the points [m] towards the camera.
            aspect: Width of the picture over its height.
            margin: Share of the picture that stays free at each edge.
        """
        axes = Camera(direction, (0.0, 0.0, 0.0), up).axes()
        turned = points.astype(float) @ axes.T
        centre = (turned.min(0) + turned.max(0)) / 2
        turned = turned - centre
        half = np.tan(field_of_view / 2) * (1 - 2 * margin)
        distance = float((np.abs(turned[:, :2]) / (half * aspect, half) + turned[:, 2:]).max()) + 10 * NEAR
        target = centre @ axes
        position = target + distance * axes[2]
        return Camera(tuple(position.tolist()), tuple(target.tolist()), up, field_of_view)

    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Right, up and backward of the picture in world coordinates, as rows."""
        backward = unit(np.subtract(self.position, self.target))
        up = np.asarray(self.up, float)
        if np.linalg.norm(np.cross(up, backward)) < 1e-6 * np.linalg.norm(up):
            up = np.eye(3)[np.abs(backward).argmin()]
        right = unit(np.cross(up, backward))
        return np.stack([right, np.cross(backward, right), backward])

    def project(
        self, corners: Float[np.ndarray, "f 3 3"], width: int, height: int
    ) -> tuple[Float[np.ndarray, "f 3 3"], Bool[np.ndarray, " f"]]:
        """Pixel coordinates and inverse depth [1/m] of triangle corners, and which triangles lie before the camera.

        Corners are in the camera's axes [m], width and height those of the picture [pixels].
        """
        depth = -corners[..., 2]
        visible = np.asarray((depth > NEAR).all(1))
        focal = height / 2 / np.tan(self.field_of_view / 2)
        inverse = 1 / np.maximum(depth, NEAR)
        x = width / 2 + focal * corners[..., 0] * inverse
        y = height / 2 - focal * corners[..., 1] * inverse
        return np.stack([x, y, inverse], -1), visible
