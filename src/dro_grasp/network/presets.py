"""The network's configuration, and the named configurations that training offers."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin, get_type_hints

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import OptionError

WIDEST = 4096  # Largest number of points, features or neighbours (ours): memory grows with their products
MAX_LAYERS = 16  # Most layers of a part of the network (ours)
LARGEST = 10.0  # Largest distance [m] and temperature (ours)
LAST_WITH_OTHERS = "commit e1ba941"  # Last state of the package whose networks had other forms, and that shipped other weights
FORMER: dict[str, dict[str, str]] = {
    "object": {"latent_form": "kernel", "prior": "standard", "placement_hand": "features"},
    "palm": {"latent_form": "motion", "prior": "flow", "placement_hand": "proportions"},
}
"""Settings in files that the frame decides now, with what it decides."""


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes and forms. The defaults are the paper's."""

    n_hand: int = 512
    """Points of the hand's cloud."""
    n_object: int = 512
    """Points of the object's cloud."""
    width: int = 512
    """Feature dimension D."""
    encoder_widths: tuple[int, ...] = (64, 64, 128, 256, 512)
    """Outputs of the edge layers."""
    neighbours: int = 32
    """K of the encoders' graphs."""
    heads: int = 4
    """Attention heads."""
    attention_hidden: int = 1024
    """Hidden width of the transformers' feed-forward layers."""
    latent: int = 64
    """Dimension of z."""
    latent_widths: tuple[int, ...] = (64, 64, 128, 256)
    """Edge layers of the latent encoder."""
    latent_head: tuple[int, int] = (512, 256)
    """Fully connected layers of the latent encoder."""
    latent_neighbours: int = 20
    """K of the latent encoder's graph."""
    frame: Literal["object", "palm"] = "object"
    """Axes of both clouds, and with them the form of the network. With `object`, the paper's, the hand is zero-centred: the
    network sees which way it is turned, not where it is, and any wrist rotation is as good as another; z enters the kernel
    alone, and is drawn from N(0, I). With `palm`, whose axes mean the same for every hand, the network knows the placement: it
    has a learned prior of placements, z also moves the placed open hand and is drawn by a flow that knows hand and object,
    and the kernel is added to the distances of the hand that z has moved."""
    kernel_hidden: tuple[int, int] = (300, 100)
    """Hidden layers of the kernel."""
    initial_distance: float = 0.1
    """Distance that an untrained kernel predicts [m]; softplus alone starts at 0.69."""
    placement_width: int = 128
    """Width of the placement prior."""
    placement_components: int = 8
    """Components of its mixture."""
    placement_temperature: float = 0.7
    """Scale of the spread of placements drawn at inference."""

    def __post_init__(self) -> None:
        for name, kind in get_type_hints(NetworkConfig).items():
            if not _fits(value := getattr(self, name), kind):
                raise OptionError(f"{name} is {str(value)[:60]}, which no network has; the paper's is "
                                  f"{getattr(NetworkConfig, name)}")
        if self.width % self.heads or self.neighbours > min(self.n_hand, self.n_object):
            raise OptionError(f"width is {self.width}, heads {self.heads}, neighbours {self.neighbours}; expected a width "
                              "that is a multiple of the heads, and no more neighbours than points")

    @property
    def placed(self) -> bool:
        """Whether the network knows where the open hand is; the paper's discards it."""
        return self.frame != "object"

    def axes(self, palm_axes: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
        """The axes in which the network works, as columns in the wrist frame, of a hand with these `palm_axes_wrist`."""
        return palm_axes if self.frame == "palm" else torch.eye(3, device=palm_axes.device)

    def differences(self, other: NetworkConfig) -> dict[str, tuple[Any, Any]]:
        """Settings in which two configurations differ: (own, other) by name."""
        pairs = {f.name: (getattr(self, f.name), getattr(other, f.name)) for f in dataclasses.fields(self)}
        return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}

    @staticmethod
    def preset(name: str) -> NetworkConfig:
        """A named configuration.

        That is `paper` (14 M parameters), `paper-slim`, the same form as narrow as the default weights, or `multi`, that of
        the default weights (1.5 M), which is also called `slim`.
        """
        if name not in PRESETS:
            raise OptionError(f"no network is called '{name}'; choose {', '.join(PRESETS)}")
        return PRESETS[name]

    @staticmethod
    def from_dict(values: dict[str, Any]) -> NetworkConfig:
        """From plain values, as a weights file stores them; lists become tuples."""
        plain: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        form = str(plain.get("frame", "object"))
        for name, fixed in FORMER.get(form, {}).items():
            if (found := plain.pop(name, fixed)) != fixed:
                raise ValueError(f"{name} is no longer a choice; in frame '{form}' it is {fixed} now, and {found} in the file, "
                                 f"as networks of {LAST_WITH_OTHERS} could have it")
        if unknown := sorted(plain.keys() - {f.name for f in dataclasses.fields(NetworkConfig)}):
            raise ValueError(f"unknown settings {', '.join(unknown)}")
        try:
            return NetworkConfig(**plain)
        except OptionError as error:  # the settings are a file's, not the user's
            raise ValueError(str(error)) from error


def _fits(value: Any, kind: Any) -> bool:
    if get_origin(kind) is Literal:
        return isinstance(value, str) and value in get_args(kind)
    if kind is float:
        return type(value) in (int, float) and 0 < value <= LARGEST
    if kind is int:
        return type(value) is int and 0 < value <= WIDEST
    each = get_args(kind)
    length = isinstance(value, tuple) and 0 < len(value) <= MAX_LAYERS and (Ellipsis in each or len(value) == len(each))
    return length and all(_fits(x, int) for x in value)


SLIM = NetworkConfig(
    n_hand=160, n_object=128, width=128, encoder_widths=(32, 32, 64, 128), neighbours=16, attention_hidden=256, latent=32,
    latent_widths=(32, 32, 64), latent_head=(128, 128), latent_neighbours=12, kernel_hidden=(128, 64), frame="palm",
    placement_temperature=0.3,
)
"""A network narrow enough to train on a CPU; it knows the placement. Source: ours."""
PRESETS = {
    "paper": NetworkConfig(),
    "paper-slim": dataclasses.replace(SLIM, frame="object", latent=64),
    "slim": SLIM,
    "multi": SLIM,
}
"""Configurations by name (`NetworkConfig.preset`)."""
