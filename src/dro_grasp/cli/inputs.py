"""What commands are given: switches and options, protocols by name, and what grasps have to respect."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from dro_grasp.errors import ObjectError, UngraspableError
from dro_grasp.simulation.protocols import PROTOCOLS

if TYPE_CHECKING:
    from dro_grasp.objects.scenery import Scene
    from dro_grasp.objects.shape import ObjectModel
    from dro_grasp.predict.constraints import Constraints

    ProtocolName = str
else:
    ProtocolName = Literal[tuple(PROTOCOLS)]

Ball = tuple[float, float, float, float]  # Centre and radius [m]
Mass = Annotated[float | None, tyro.conf.arg(metavar="KG", help_behavior_hint="(default: density times volume)")]
Friction = Annotated[float, tyro.conf.arg(
    metavar="MU", help="Friction between hand, objects and table, in simulation and in the planner's rehearsals.")]
Flag = tyro.conf.FlagCreatePairsOff[bool]  # A switch that is off by default and has no --no- form


def optional(metavar: str, default: str) -> Any:
    """Help settings of an option without a default value: its metavar, and a description of the default."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


def load_obstacle(name: str) -> ObjectModel:
    """A thing that is not grasped, and on which another may be put.

    Raises:
        ObjectError: It cannot be loaded as a thing; of one of another size, and of a sheet, the message says how it is avoided.
    """
    from dro_grasp.objects.catalogue import load_object

    try:
        return load_object(name)
    except UngraspableError as error:
        raise ObjectError(
            f"{error.fault}. --obstacles takes clouds and meshes of things, in metres, 5 mm to 1 m large, meshes with an "
            "inside; all else to stay clear of is given with --surroundings, a mesh or cloud of any size") from error


def given_forces(margin: float | None, max_force: float | None) -> str:
    """Which options of how hard hands squeeze are given, in words; empty for none."""
    return " and ".join(name for name, value in (("--margin", margin), ("--max-force", max_force)) if value is not None)


@dataclass(frozen=True)
class PalmOptions:
    """Where palms point, how far hands open, and how hard they squeeze."""

    direction: Annotated[tuple[float, float, float] | None, optional("X Y Z", "any direction")] = None
    """Palm direction: 0 0 -1 grasps from above. Over a table, palms also tilt down as far as the hand needs room."""
    max_tilt: Annotated[float | None, optional("RAD", "roughly along the direction")] = None
    """Largest angle [rad] between the palm direction and --direction. Palms are spread evenly within it."""
    pregrasp_clearance: Annotated[float | None, optional("M", "a quarter of what is left")] = None
    """Least distance [m] between the object and every link that closes, in pregrasp."""

    margin: Annotated[float | None, optional("TIMES", "1.5")] = None
    """Multiple of the object's weight that the squeeze holds, whichever way gravity pulls."""
    max_force: Annotated[float | None, optional("N", "any")] = None
    """Largest normal force [N] of a contact at the squeeze, for soft and fragile things."""

    def constraints(self, table: float | None = None, obstacles: Scene | None = None) -> Constraints:
        """These options, with a table's height [m] and what stands around."""
        from dro_grasp.predict.constraints import Constraints

        return Constraints(table=table, obstacles=obstacles, **asdict(self))


@dataclass(frozen=True)
class ConstraintOptions(PalmOptions):
    """Where palms point, how far hands open, how hard they squeeze, and where they touch."""

    contact_region: Annotated[tuple[Ball, ...], optional("X Y Z RADIUS", "anywhere")] = ()
    """Balls [m], four numbers each. In the grasp the hand touches the object only inside them."""
    keep_out: Annotated[tuple[Ball, ...], optional("X Y Z RADIUS", "nothing")] = ()  # Balls [m] that the hand stays out of.
