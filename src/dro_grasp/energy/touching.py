"""The energy of touching an object elsewhere than wanted: contacts are drawn to a place, other hand points kept off."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.energy.terms import PointTerm
from dro_grasp.geometry.distance_field import Balls


class Touching:
    """A place on an object, as balls, in which all contacts are to be."""

    def __init__(self, place: Balls, clear: float) -> None:
        """On the device of the evaluations.

        Args:
            place: Where the hand may touch the object.
            clear: Distance that it keeps from the object elsewhere [m].
        """
        self.place, self.clear = place, clear

    def beside(self, points: Float[Tensor, "*b p 3"]) -> Bool[Tensor, "*b p"]:
        """Which points are outside the place."""
        return self.place.distances(points)[0] > 0

    def pull(self, contacts: Float[Tensor, "*b c 3"]) -> PointTerm:
        """Distance of each contact to the place [m]; zero inside."""
        distance, gradient = self.place.distances(contacts)
        outside = (distance > 0).to(distance.dtype)
        return PointTerm(distance * outside, gradient * outside[..., None])

    def push(
        self, points: Float[Tensor, "*b p 3"], distance: Float[Tensor, "*b p"], gradient: Float[Tensor, "*b p 3"]
    ) -> PointTerm:
        """How much nearer than `clear` each hand point outside the place is to the object [m].

        Args:
            points: Hand points [m].
            distance: Their signed distances to the object [m].
            gradient: The distances' gradients.
        """
        near = (self.beside(points) & (distance < self.clear)).to(distance.dtype)
        return PointTerm((self.clear - distance) * near, -gradient * near[..., None])
