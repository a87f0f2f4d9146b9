"""A hand and an object, prepared once on one device for every stage of the pipeline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.devices import require_device
from dro_grasp.geometry.distance_field import Balls, DistanceField
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import TABLE
from dro_grasp.grasps.sources import require_pair
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel, solid_of
from dro_grasp.optimize.grasp_energy import Clearance, EnergyConfig, GraspEnergy, Surroundings, Workspace
from dro_grasp.optimize.starts import APPROACH
from dro_grasp.predict.constraints import Constraints, lies_low


@dataclass(frozen=True, eq=False)
class GraspProblem:
    """What the stages derive from a hand and an object, each thing made at first use and then shared.

    Examples:
        >>> problem = GraspProblem(load_hand("allegro"), load_object("mug"))
        >>> grasps = evaluate(problem, rank(problem, refine(problem, grasps)), "carry")
    """

    hand: Hand
    """On the CPU, where grasps stay."""
    obj: ObjectModel
    """A mesh or a bare point cloud."""
    device: torch.device | str = "cpu"
    """Where the network, the grasp energy and, on CUDA, the simulations of settling run."""
    constraints: Constraints = field(default_factory=Constraints)
    """What grasps have to respect."""
    fixed: tuple[str, ...] = ()
    """Names of those that describe a place as it is, which nobody can relax: no advice names them."""
    _energies: dict[EnergyConfig, GraspEnergy] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        """Refuse what is no hand or no object, an absent device, and constraints that leave nothing of the object.

        Raises:
            OptionError: Something else was given, this machine has no such device, or nothing is left of the object.
            ObjectError: The obstacles contain the object.
        """
        require_pair(self.hand, self.obj)
        require_device(str(self.device))
        self.constraints.require_fit(self.obj)

    @property
    def height_range(self) -> tuple[float, float]:
        """Least and greatest z of the object [m]."""
        return float(self.obj.cloud[:, 2].min()), float(self.obj.cloud[:, 2].max())

    @cached_property
    def table(self) -> Float[Tensor, "4"] | None:
        """Upward unit normal and height [m] of the table, on the CPU; None without one."""
        plane = None if self.surroundings is None else self.surroundings.plane
        return None if plane is None else plane.cpu()

    @cached_property
    def lies_flat(self) -> bool:
        """Whether the object lies low on a table that fingertips may touch."""
        around = self.surroundings
        return self.table is not None and around is not None and around.touch_plane and lies_low(self.obj, self.table)

    def on_table(self, grasps: GraspBatch) -> GraspBatch:
        """The grasps with the table that is there while the hand closes, in simulation too, or with none."""
        extra = {name: column for name, column in grasps.extra.items() if name != TABLE}
        if self.table is not None:
            extra[TABLE] = self.table.repeat(len(grasps), 1)
        return grasps.replace(extra=extra)

    @property
    def hand_reach(self) -> float:
        """How far the hand gets from the object on a straight approach [m]: the way, and its size."""
        points = self.hand.points(self.hand.canonical_joints(1.0))
        return APPROACH + float((points - self.hand.grasp_centre_wrist).norm(dim=-1).max())

    @cached_property
    def contact_points(self) -> Float[Tensor, "k 3"] | None:
        """Points of the object's cloud in the contact region, on the CPU [m]; None where all of it may be touched."""
        if (place := Balls.of(self.constraints.contact_region)) is None:
            return None
        cloud = torch.from_numpy(self.obj.cloud)
        return cloud[place.distances(cloud)[0] <= 0]

    @cached_property
    def solid(self) -> ObjectModel:
        """The object as closing is simulated on it: balls stand for a bare cloud."""
        return solid_of(self.obj)

    @property
    def mass(self) -> float:
        """The object's mass; of a bare cloud, of what it encloses [kg]."""
        return self.solid.mass

    @cached_property
    def centre(self) -> Float[Tensor, "3"]:
        """The object's centre of mass, on the CPU [m]."""
        return torch.as_tensor(self.obj.centre_of_mass, dtype=torch.float32)

    @property
    def field(self) -> DistanceField:
        """Signed distances of the object, on the device."""
        field = self._default_energy.field
        assert isinstance(field, DistanceField)
        return field

    @property
    def workspace(self) -> Workspace:
        """Where the hand may be, and where it may touch the object, on the device."""
        return self._default_energy.workspace

    @property
    def surroundings(self) -> Surroundings | None:
        """What the hand stays clear of, on the device; None for nothing."""
        return self.workspace.surroundings

    @property
    def joins(self) -> bool:
        """Whether it may be computed together with other objects: where hands may be, and touch, is not limited."""
        return self._default_energy.joins(self._default_energy)

    @property
    def clearance(self) -> Clearance | None:
        """Distance of the hand, with all its surface points, to the surroundings."""
        return self.energy(EnergyConfig(clearance_points=self.hand.n_points)).clearance

    def energy(self, config: EnergyConfig) -> GraspEnergy:
        """The grasp energy under these weights; contacts, link spheres and distance field are shared among all weights."""
        if config not in self._energies:
            self._energies[config] = self._default_energy.weighted(config)
        return self._energies[config]

    @cached_property
    def _default_energy(self) -> GraspEnergy:
        return GraspEnergy.of_object(
            self.hand, self.obj, device=self.device, workspace=self.constraints.workspace(self.obj, self.hand_reach))

    def beside(self, obj: ObjectModel) -> GraspProblem:
        """The problem of another object, with what is prepared of the hand shared."""
        other = GraspProblem(self.hand, obj, self.device, self.constraints)
        around = self.constraints.workspace(obj, self.hand_reach)
        vars(other)["_default_energy"] = self._default_energy.on(obj, around)
        return other

    def thinned(self, count: int) -> Hand:
        """The hand with `count` surface points, on the device.

        Raises:
            OptionError: The hand has fewer points.
        """
        return self.hand.with_points(count).to(self.device)

    def cloud(self, count: int, generator: torch.Generator) -> Float[Tensor, "count 3"]:
        """Random surface points of the object, or of the contact region, on the device [m]."""
        if self.contact_points is None:
            return self.obj.sample_points(count, generator).to(self.device)
        return self.contact_points[torch.randint(len(self.contact_points), (count,), generator=generator)].to(self.device)


def problems_of(
    hand: Hand, objects: Sequence[ObjectModel], device: torch.device | str, constraints: Constraints
) -> list[GraspProblem]:
    """Problems of several objects, for which the hand is prepared once; errors as of `GraspProblem`."""
    if not objects:
        return []
    first = GraspProblem(hand, objects[0], device, constraints)
    return [first, *(first.beside(obj) for obj in objects[1:])]
