"""A hand alone, and where other grasps are, on a page."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.apps.viewer.scene_view import Client, add_hand, beside_ray, move, rgb
from dro_grasp.geometry.rendering.rasterizer import Colour
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand

BALL = 0.007  # Radius of the ball that marks a grasp's wrist [m]
RATED = np.array([(0.82, 0.28, 0.24), (0.95, 0.77, 0.25), (0.20, 0.66, 0.36)])
"""Colours of grasps that hardly hold, that hold half of the times, and that surely hold: red, yellow, green."""
OUT: Colour = (0.72, 0.72, 0.74)  # Colour of a grasp that cannot be carried out


class HandView:
    """A hand alone, hidden until it is posed."""

    def __init__(self, client: Client, hand: Hand) -> None:
        """Replace the one that was there."""
        scene, self.hand, self._client = client.scene, hand, client
        scene.remove_by_name("/hand")
        self._root = scene.add_frame("/hand", show_axes=False, visible=False)
        self._links = add_hand(scene, "/hand", hand)

    def pose(self, joints: Float[Tensor, " n_dof"], T: Float[Tensor, "4 4"]) -> None:
        """Show the hand with these joints [rad or m] and this pose of the wrist [m]."""
        with torch.no_grad():
            poses = (T @ self.hand.tree.forward(joints)).double().numpy()
        with self._client.atomic():
            for frame, pose in zip(self._links, poses, strict=True):
                move(frame, pose)
            self._root.visible = True

    def hide(self) -> None:
        """Show no hand."""
        self._root.visible = False


class GraspMarks:
    """A ball at the wrist of each grasp, with a line to where it grasps; its colour says how sure it is."""

    def __init__(self, client: Client) -> None:
        self._client, self.wrists = client, np.zeros((0, 3))

    def show(self, hand: Hand, grasps: GraspBatch, usable: list[bool]) -> None:
        """Show these grasps in the place of others; those that are of no use are grey."""
        scene, T = self._client.scene, grasps.T_object_wrist.float()
        self.hide()
        self.wrists = T[:, :3, 3].double().numpy()
        centres = hand.grasp_centres(T).double().numpy()
        colours = [colour_of(float(c)) if use else OUT for c, use in zip(grasps.confidence, usable, strict=True)]
        with self._client.atomic():
            for i, (wrist, colour) in enumerate(zip(self.wrists, colours, strict=True)):
                scene.add_icosphere(f"/marks/{i}", BALL, rgb(colour), position=tuple(wrist.tolist()))
            if len(self.wrists):
                rows = np.array([rgb(colour) for colour in colours], np.uint8)
                scene.add_line_segments(
                    "/marks/lines", np.stack([self.wrists, centres], 1).astype(np.float32),
                    np.repeat(rows[:, None], 2, 1), thickness=1.5, thickness_units="screen")

    def hide(self) -> None:
        """Show none."""
        self._client.scene.remove_by_name("/marks")
        self.wrists = np.zeros((0, 3))

    def hit(self, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]) -> int | None:
        """The grasp whose ball a ray meets first; None for none."""
        depth, aside = beside_ray(self.wrists, origin, direction)
        met = np.flatnonzero((depth > 0) & (aside < 1.5 * BALL))
        return int(met[depth[met].argmin()]) if len(met) else None


def colour_of(confidence: float) -> Colour:
    """From red over yellow to green, by the probability that a grasp holds; as unsure where it is unknown."""
    share = float(np.clip(np.nan_to_num(confidence), 0.0, 1.0))
    red, green, blue = (float(np.interp(share, (0.0, 0.5, 1.0), column)) for column in RATED.T)
    return red, green, blue
