"""Named, versioned protocols of grasp trials."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

from dro_grasp.errors import OptionError
from dro_grasp.grasps.controller_config import ControllerConfig
from dro_grasp.kinds import Checked

NAME = re.compile(r"[\w.-]+")  # Names of protocols: nothing that stands between the parts of a label
ABOVE_ZERO = ("friction", "mass", "mass_factor", "closing_time", "force_time", "timestep", "impratio", "stiffness",
              "force_limit", "lever")
"""Numbers of a protocol that are above 0."""
FROM_ZERO = ("torsional_friction", "force", "noslip", "damping", "armature")  # Those that may be 0, too
LIMITS = ("max_displacement", "max_rotation", "max_closing_shift", "max_closing_rotation", "max_penetration",
          "max_self_penetration")
"""What a success stays below."""
SHORTEST_RAMP = 20  # Time steps of a gradual closing, at least: each of its halves moves the targets in ten


@dataclass(frozen=True)
class Perturbations(Checked):
    """How a grasp is evaluated several times under other conditions; by default it is not.

    The first trial is the protocol's own. The conditions of each other trial are drawn for this grasp alone: where the
    object stands, and factors between two bounds, uniform in their logarithm.
    """

    trials: int = 1
    """Trials of each grasp."""
    needed: int = 1
    """Trials in which a success must hold."""
    coarse: int = 0
    """Trials, the last ones, in which the object collides as its coarse parts."""
    shift: float = 0.0
    """The object stands this far from its place, in a random direction [m]."""
    turn: float = 0.0
    """It is turned by this angle, about a random axis through its centre of mass [rad]."""
    friction: tuple[float, float] = (1.0, 1.0)
    """Factor of the friction, torsional friction included."""
    mass: tuple[float, float] = (1.0, 1.0)
    """Factor of the object's mass, and with it of the disturbing forces."""
    gain: tuple[float, float] = (1.0, 1.0)
    """Factor of the servos' stiffness and damping."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense: OptionError."""
        super().__post_init__()
        if not (1 <= self.needed <= self.trials and 0 <= self.coarse < self.trials):
            raise OptionError(f"{self.trials} trials, {self.needed} of them needed and {self.coarse} coarse; "
                              "need at least 1 and at most all, and make fewer coarse than all")
        for name in ("friction", "mass", "gain"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise OptionError(f"{name} is {(low, high)}; give a smallest and a largest factor above 0")


@dataclass(frozen=True)
class Protocol(Checked):
    """How a trial runs and when it counts as a success."""

    name: str
    """Name, as stored with outcomes: letters, digits, `_`, `-` and `.`."""
    version: int = 1
    """Goes up with every change that can change a verdict."""
    closing: bool = True
    """Start at the pregrasp and close onto the squeeze target; otherwise start and stay at the grasp."""
    controller: ControllerConfig = field(default_factory=ControllerConfig)
    """Makes a pregrasp and a squeeze for grasps that do not state them."""
    friction: float = 1.0
    """Coefficient between hand and object. (The official release has 3.0.)"""
    mass: float | None = None
    """Mass of every object [kg]; None leaves the object's own."""
    mass_factor: float = 1.0
    """Multiplies the object's mass and with it the disturbing forces."""
    torsional_friction: float = 0.02
    """Torsional friction between hand and object [m]."""
    force: float = 0.5
    """Disturbing force per object mass [m/s^2]. Source: paper, evaluation metric details."""
    closing_time: float = 1.0
    """Time in which the hand closes [s]."""
    gradual: bool = False
    """Move the targets from the pregrasp to the grasp and on to the squeeze, each in half of the closing time; otherwise
    the squeeze is the target from the start."""
    reset: bool = False
    """Start each force from the end of closing; otherwise each starts where the previous one ended. With a reset the
    object's motion counts from the labelled grasp, not from the end of closing, and the grasp must withstand every
    force."""
    force_time: float = 1.0
    """Duration of the force along each of +x +y +z -x -y -z of the object's frame [s]."""
    max_displacement: float = 0.02
    """The displacement of the object must stay below this [m]. Source: paper, evaluation metric."""
    max_rotation: float = math.inf
    """The rotation of the object must stay below this [rad]."""
    max_closing_shift: float = math.inf
    """Largest displacement of the object while the hand closes [m]."""
    max_closing_rotation: float = math.inf
    """Largest rotation of the object while the hand closes [rad]."""
    max_penetration: float = math.inf
    """Largest penetration of hand and object in the labelled grasp [m]."""
    max_self_penetration: float = math.inf
    """Largest summed penetration of the hand's links in the labelled grasp [m]."""
    timestep: float = 0.005
    """Time step of the simulation [s]; with 1 ms nearly all verdicts are the same."""
    impratio: float = 10.0
    """Ratio of frictional to normal impedance; at 1 objects creep."""
    noslip: int = 0
    """Iterations of the solver that removes residual slip."""
    stiffness: float = 3.0
    """Gain of the position servos [Nm/rad]; 100 ejects objects."""
    damping: float = 0.3
    """Damping of the servos [Nms/rad]."""
    armature: float = 1e-3
    """Inertia that is added to every joint [kg m^2]."""
    force_limit: float = 20.0
    """Largest servo torque [Nm]."""
    effort: bool = False
    """Whether a servo's torque ends at its joint's effort instead (see `find_efforts`)."""
    lever: float = 0.03
    """Lever arm of sliding joints [m]: they get the servo of a turning joint that acts at this distance."""
    perturbations: Perturbations = field(default_factory=Perturbations)
    """Further trials of each grasp under other conditions."""

    def __post_init__(self) -> None:
        """Refuse a name that labels could not be told apart with, and numbers that no trial has: OptionError."""
        super().__post_init__()
        if not NAME.fullmatch(self.name):
            raise OptionError(f"'{self.name}' is no name of a protocol; use letters, digits, '_', '-' and '.'")
        for name in (*ABOVE_ZERO, *FROM_ZERO):
            value, least = getattr(self, name), "above 0" if name in ABOVE_ZERO else "from 0 on"
            if value is not None and not (0 < value < math.inf or (value == 0 and name in FROM_ZERO)):
                raise OptionError(f"{name} of protocol '{self.name}' is {value}; give a number {least} ({name}=...)")
        if wrong := [name for name in LIMITS if not getattr(self, name) > 0]:
            raise OptionError(f"{wrong[0]} of protocol '{self.name}' is {getattr(self, wrong[0])}; give a number above 0, or "
                              f"inf for no limit ({wrong[0]}=...)")
        if self.gradual and self.closing_time < SHORTEST_RAMP * self.timestep:
            raise OptionError(f"closing_time of protocol '{self.name}' is {self.closing_time} s, less than {SHORTEST_RAMP} "
                              f"time steps of {self.timestep} s; give more, or a shorter timestep")

    @property
    def label(self) -> str:
        """Name and version, as stored with outcomes, with every number that differs from the protocol of this name.

        A difference, or one from the defaults where no protocol has the name, is written `+field=value`; friction is
        written `+friction3`.
        """
        changes = "".join(_differences(self, PROTOCOLS.get(self.name) or Protocol(self.name)))
        return f"{self.name}{changes.replace('+friction=', '+friction')}/{self.version}"


def _differences(rules: Any, named: Any, prefix: str = "+") -> Iterator[str]:
    """Each field that has another value than the named protocol's, with its value; numbers that are equal look equal."""
    for one in fields(rules):
        value, usual = getattr(rules, one.name), getattr(named, one.name)
        if is_dataclass(value):
            yield from _differences(value, usual, f"{prefix}{one.name}.")
        elif value != usual and one.name != "version":
            yield f"{prefix}{one.name}={','.join(map(_shortly, value)) if isinstance(value, tuple) else _shortly(value)}"


def _shortly(value: float | None) -> str:
    """A number in as few digits as tell it from all others; a truth value or None as it is."""
    if value is None or isinstance(value, bool):
        return str(value)
    return short if float(short := f"{value:g}") == value else repr(float(value))


STRICT = Protocol(
    "strict", max_closing_shift=0.02, max_closing_rotation=math.radians(30), max_penetration=0.005,
    max_self_penetration=0.005,
)
"""The paper's trial with limits on closing and penetration (ours)."""
ROBUST = Perturbations(
    trials=8, needed=6, coarse=4, shift=0.005, turn=math.radians(5), friction=(0.4, 1.2), mass=(0.5, 2.0), gain=(0.5, 2.0))
"""What a robot does not know exactly (ours).

With 6 of 8, a grasp that holds in nine of ten trials fails 4 % of the time, and one that holds in every second trial passes
14 % of the time. All 8 would fail 57 % of the former, 5 of 8 would pass 36 % of the latter.
"""
CARRY = Protocol(
    "carry", friction=0.5, torsional_friction=0.005, force=9.81, gradual=True, reset=True, max_rotation=math.radians(15),
    max_penetration=STRICT.max_penetration, max_self_penetration=STRICT.max_self_penetration, noslip=2, effort=True,
)
"""What a robot that lifts things asks for: the object's weight in any direction, and fingers as strong as they are (ours)."""
PROTOCOLS = {
    "carry": CARRY,
    "dro": Protocol("dro"),
    "strict": STRICT,
    "robust": replace(STRICT, name="robust", perturbations=ROBUST),
    "dro_static": Protocol("dro_static", closing=False),
    "dexgraspbench": Protocol(
        "dexgraspbench", friction=0.6, mass=0.1, force=10.0, closing_time=0.8, gradual=True, reset=True, force_time=2.0,
        max_displacement=0.05, max_rotation=math.radians(15), max_penetration=0.01, timestep=0.004, noslip=2, stiffness=5.0,
        force_limit=3.0,
    ),
}
"""Every protocol by name, in the order of lists of choices; a new one is one entry here.

Sources: the paper for `dro`, ours for `strict`, `robust` and `dro_static`, the settings of DexGraspBench.
"""
DEFAULT_PROTOCOL = "carry"  # Name of the protocol of trials for which none is named: grasps are to lift things (ours)


def protocol(name: str | Protocol) -> Protocol:
    """The protocol of a name; a Protocol is returned unchanged. OptionError: no protocol has this name."""
    if isinstance(name, Protocol):
        return name
    if name not in PROTOCOLS:
        raise OptionError(f"no protocol is called '{name}'; choose one of {', '.join(PROTOCOLS)}")
    return PROTOCOLS[name]


def changed(name: str | Protocol, *, friction: float | None = None, mass_factor: float = 1.0) -> Protocol:
    """A protocol with another friction (None: its own), or multiple of the mass; OptionError: out of range, or no protocol."""
    rules = protocol(name)
    if friction is not None and not 0 < friction <= 10:
        raise OptionError(f"friction is {friction}; give a coefficient between 0 and 10")
    if not 0 < mass_factor <= 100:
        raise OptionError(f"mass_factor is {mass_factor}; give a factor between 0 and 100")
    return replace(rules, friction=rules.friction if friction is None else friction, mass_factor=mass_factor)
