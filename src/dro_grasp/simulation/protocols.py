"""Named, versioned protocols of grasp trials."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from dro_grasp.errors import OptionError
from dro_grasp.grasps.controller_config import ControllerConfig


@dataclass(frozen=True)
class Protocol:
    """How a trial runs and when it counts as a success."""

    name: str
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
    """[m]"""
    force: float = 0.5
    """Disturbing force per object mass [m/s^2]. Source: paper, evaluation metric details."""
    closing_time: float = 1.0
    """[s]"""
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
    """Largest displacement of the object after all forces [m]. Source: paper, evaluation metric."""
    max_rotation: float = math.inf
    """Largest rotation of the object after all forces [rad]."""
    max_closing_shift: float = math.inf
    """Largest displacement of the object while the hand closes [m]."""
    max_closing_rotation: float = math.inf
    """Largest rotation of the object while the hand closes [rad]."""
    max_penetration: float = math.inf
    """Deepest penetration of hand and object in the labelled grasp [m]."""
    max_self_penetration: float = math.inf
    """Summed penetration of the hand's links in the labelled grasp [m]."""
    timestep: float = 0.005
    """[s]; 5 ms agrees with 1 ms on 97 % of verdicts."""
    impratio: float = 10.0
    """Friction to normal impedance; at 1 objects creep."""
    noslip: int = 0
    """Iterations of the solver that removes residual slip."""
    stiffness: float = 3.0
    """Gain of the position servos [Nm/rad]; 100 ejects objects."""
    damping: float = 0.3
    """[Nms/rad]"""
    armature: float = 1e-3
    """[kg m^2]"""
    force_limit: float = 20.0
    """Largest servo torque [Nm]."""
    lever: float = 0.03
    """Lever arm of sliding joints [m]: they get the servo of a turning joint that acts at this distance."""

    @property
    def label(self) -> str:
        """Name and version, as stored with results, marked if friction or anything else was changed."""
        named = PROTOCOLS.get(self.name, self)
        friction = "" if self.friction == named.friction else f"+friction{self.friction:g}"
        changed = "" if replace(self, friction=named.friction) == named else "+changed"
        return f"{self.name}{friction}{changed}/{self.version}"


PROTOCOLS = {
    "dro": Protocol("dro"),
    "strict": Protocol(
        "strict", max_closing_shift=0.02, max_closing_rotation=math.radians(30), max_penetration=0.005,
        max_self_penetration=0.005,
    ),
    "dro_static": Protocol("dro_static", closing=False),
    "dexgraspbench": Protocol(
        "dexgraspbench", friction=0.6, mass=0.1, force=10.0, closing_time=0.8, gradual=True, reset=True, force_time=2.0,
        max_displacement=0.05, max_rotation=math.radians(15), max_penetration=0.01, timestep=0.004, noslip=2, stiffness=5.0,
        force_limit=3.0,
    ),
}
"""Every protocol by name, in the order of lists of choices; a new one is one entry here.

Sources: the paper for `dro`, ours for `strict` and `dro_static`, the settings of DexGraspBench.
"""


def protocol(name: str | Protocol) -> Protocol:
    """The protocol of a name; a Protocol is returned unchanged.

    Raises:
        OptionError: No protocol has this name.
    """
    if isinstance(name, Protocol):
        return name
    if name not in PROTOCOLS:
        raise OptionError(f"no protocol is called '{name}'; choose one of {', '.join(PROTOCOLS)}")
    return PROTOCOLS[name]


def changed(name: str | Protocol, *, friction: float | None = None, mass_factor: float = 1.0) -> Protocol:
    """A protocol with another friction or mass.

    Args:
        name: The protocol.
        friction: Coefficient between hand and object; None keeps the protocol's.
        mass_factor: Multiplies the object's mass.

    Raises:
        OptionError: A value is out of range, or no protocol has the name.
    """
    rules = protocol(name)
    if friction is not None and not 0 < friction <= 10:
        raise OptionError(f"friction is {friction}; give a coefficient between 0 and 10")
    if not 0 < mass_factor <= 100:
        raise OptionError(f"mass_factor is {mass_factor}; give a factor between 0 and 100")
    return replace(rules, friction=rules.friction if friction is None else friction, mass_factor=mass_factor)
