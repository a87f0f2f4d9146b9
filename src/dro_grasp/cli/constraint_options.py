"""What grasps have to respect, as options of the commands that make them; the command says in which frame."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

from dro_grasp.cli.inputs import Ball, optional

if TYPE_CHECKING:
    from dro_grasp.objects.scenery import Scene
    from dro_grasp.predict.constraints import Constraints


@dataclass(frozen=True)
class PalmOptions:
    """Where palms point, and how far hands open."""

    direction: Annotated[tuple[float, float, float] | None, optional("X Y Z", "any direction")] = None
    """Palm direction: 0 0 -1 grasps from above. Over a table, palms tilt towards it as far as the hand needs room."""
    cone: Annotated[float | None, optional("RAD", "roughly along the direction")] = None
    """Largest angle [rad] between palm direction and --direction; palms are spread evenly within it."""
    opening: Annotated[float | None, optional("M", "a quarter of what is left")] = None
    """Least distance [m] between the object and every link that closes, in pregrasp."""

    def constraints(self, table: float | None = None, avoid: Scene | None = None) -> Constraints:
        """These options, with a table's height [m] and what stands around.

        Raises:
            OptionError: Something cannot be respected.
        """
        from dro_grasp.predict.constraints import Constraints

        return Constraints(table=table, avoid=avoid, **asdict(self))


@dataclass(frozen=True)
class ConstraintOptions(PalmOptions):
    """Where palms point, how far hands open, and where they touch."""

    hold: Annotated[tuple[Ball, ...], optional("X Y Z RADIUS", "anywhere")] = ()
    """Balls [m]: in the grasp, the hand touches the object nowhere else. Four numbers for each ball."""
    spare: Annotated[tuple[Ball, ...], optional("X Y Z RADIUS", "nothing")] = ()
    """Balls [m] that the hand stays out of."""
