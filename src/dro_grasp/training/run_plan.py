"""What determines the curve of a training run: a run folder resumes only with the same."""

from __future__ import annotations

from hashlib import sha256
from typing import Any

from dro_grasp.datasets.bundle.training_file import Bundle
from dro_grasp.kinds import flat
from dro_grasp.models.network import DistanceNetwork
from dro_grasp.models.presets import NetworkConfig

BOOKKEEPING = frozenset({"minutes", "device", "log_every", "checkpoint_seconds", "tensorboard"})
"""Settings of a schedule that a resumed run may change: how long it goes on, where, and what it tells."""


def run_plan(
    config: Any, bundle: Bundle, network: NetworkConfig | None = None, **given: DistanceNetwork | None
) -> dict[str, Any]:
    """Settings, data and given weights of a run, by name; what is nested has dots in its name.

    Args:
        config: Settings of the stage, a dataclass with a `schedule`.
        bundle: Training data, of which the content counts, not the file.
        network: Configuration of the network in training.
        given: Weights that the run begins with or takes parts of, by role; their parameters count, not their names.
    """
    settings = {name: value for name, value in flat(config).items() if name.removeprefix("schedule.") not in BOOKKEEPING}
    weights = {role: None if each is None else _digest(each) for role, each in given.items()}
    about = {} if network is None else flat(network, "network.")
    return {name.removeprefix("schedule."): value for name, value in settings.items()} | about | weights | {
        "bundle": bundle.fingerprint}


def _digest(network: DistanceNetwork) -> str:
    """Twelve digits that tell parameters apart; statistics of BatchNorm do not count, as each sitting measures its own."""
    digest = sha256()
    for parameter in network.parameters():
        digest.update(parameter.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:12]
