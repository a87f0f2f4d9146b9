"""From the outcome of a trial to the columns of a grasp batch."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

REASON = "reason"
"""Further column: why a grasp failed, in words; empty for a success."""
FAILURE = "failure"
"""Further column: name of the kind of failure (`Failure`); None for a success."""
CONTACT_LINKS = "contact_links"
"""Further column: names of the links that touch the object after closing."""
FURTHER = (REASON, FAILURE, CONTACT_LINKS)
"""Further columns that a trial adds."""
MEASURED = ("success", "protocol", "displacement", "rotation", "penetration")
"""Fields of a batch that a trial fills."""


@runtime_checkable
class Trial(Protocol):
    """Outcome of one trial per grasp; every TrialResult has it."""

    @property
    def success(self) -> Bool[Tensor, " n"]:
        """Whether each grasp held."""
        ...

    @property
    def displacement(self) -> Float[Tensor, "n *directions"]:
        """Displacement of the object [m]."""
        ...

    @property
    def rotation(self) -> Float[Tensor, "n *directions"]:
        """Rotation of the object [rad]."""
        ...

    @property
    def penetration(self) -> Float[Tensor, " n"]:
        """Deepest penetration in the grasp pose [m]."""
        ...

    @property
    def protocol(self) -> str:
        """Name and version."""
        ...

    @property
    def reason(self) -> Sequence[str]:
        """Why each grasp failed; empty for a success."""
        ...

    @property
    def failure(self) -> Sequence[Enum | None]:
        """Kind of each failure; None for a success."""
        ...

    @property
    def contact_links(self) -> Sequence[Sequence[str]]:
        """Links that touch the object after closing."""
        ...


def columns_of(trial: Trial) -> tuple[dict[str, Any], dict[str, Any]]:
    """Fields and further columns of a batch, from the outcome of a trial."""
    fields = {
        "success": torch.as_tensor(trial.success), "displacement": _largest(trial.displacement),
        "rotation": _largest(trial.rotation), "penetration": _largest(trial.penetration),
    }
    further: dict[str, Any] = {REASON: list(trial.reason), CONTACT_LINKS: [list(links) for links in trial.contact_links]}
    further[FAILURE] = [failure.name if failure else None for failure in trial.failure]
    return fields, further


def _largest(values: Float[Tensor, "n *directions"]) -> Float[Tensor, " n"]:
    values = torch.as_tensor(values, dtype=torch.float32)
    return values.amax(-1) if values.ndim == 2 else values
