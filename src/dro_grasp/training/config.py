"""Typed settings of pretraining and training, with their sources."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from dro_grasp.errors import OptionError
from dro_grasp.kinds import Checked, require_positive


def _require_from_zero(config: object, *names: str) -> None:
    """Refuse fields of a configuration that are negative, infinite or NaN: OptionError."""
    for name in names:
        if not 0 <= (value := getattr(config, name)) < math.inf:
            raise OptionError(f"{name} is {value}; give a number from 0 on ({name}=...)")


@dataclass(frozen=True)
class AugmentationConfig(Checked):
    """How a training sample differs from the stored grasp."""

    object_noise: float = 0.002
    """Standard deviation of the noise on object points [m]. Source: appendix, object point cloud sampling."""
    placement_rotation: float = math.radians(4)
    """Largest rotation between the open hand's placement and the grasp's wrist pose, for networks that know the placement
    [rad]. Source: ours."""
    placement_shift: float = 0.004
    """Standard deviation of the shift between the two, along each axis [m]. Source: ours."""
    tilt: float = math.radians(30)
    """For networks that do not know the placement, the largest angle by which the open hand is turned from the grasp's wrist
    rotation, about an axis perpendicular to the direction from the wrist to the object [rad]. Source: the official
    release."""
    proportions: float = 0.1
    """Standard deviation of the noise on a hand's proportions, in their spreads over hands, for the placement prior: a few
    dozen hands are few. Source: ours."""
    partial: float = 0.0
    """Share of samples in which half of the object is seen. Source: appendix."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_from_zero(self, "object_noise", "placement_rotation", "placement_shift", "tilt", "proportions")
        if not 0 <= self.partial <= 1:
            raise OptionError(f"partial is {self.partial}; give a share from 0 to 1 (partial=...)")


@dataclass(frozen=True)
class LossConfig(Checked):
    """Weights of the four terms, and of those that are ours. Source: the official release, where nothing else is said."""

    distance: float = 1.0
    """Weight of the error of D(R,O) [m]."""
    pose: float = 0.01
    """Weight of the error of link poses [m + rad]."""
    penetration: float = 5.0
    """Weight of the penetration [m]. Differs from the release (1): at 1 the hand ends up some millimetres in the object."""
    divergence: float = 0.01
    """Weight of the KL divergence of z [nat]."""
    divergence_form: Literal["batch_mean", "official"] = "batch_mean"
    """Form of the divergence: sum over latents and mean over the batch, or the release's sum over all and sqrt(1 + x^2) - 1."""
    motion: float = 1.0
    """Weight of the mean distance between the hand as z moves it and the true grasp; not in the paper's form."""
    flow: float = 0.01
    """Weight of the flow's loss; not in the paper's form."""
    placement: float = 0.01
    """Weight of the placement prior's loss; it shares no parameter with the rest."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_from_zero(self, "distance", "pose", "penetration", "divergence", "motion", "flow", "placement")


LOSSES = {"ours": LossConfig(), "release": LossConfig(penetration=1.0, divergence_form="official")}
"""Losses by name; `release` has the weights of the official release and its form of the divergence."""


@dataclass(frozen=True)
class ScheduleConfig(Checked):
    """Optimiser, checkpoints and log of pretraining and training."""

    steps: int = 10_000
    """Optimiser steps."""
    minutes: float | None = None
    """Time limit [min]; the learning rate follows steps or time, whichever is further on."""
    learning_rate: float = 1e-3
    """Peak of Adam's learning rate. Differs from the paper (1e-4): better at equal time on a CPU."""
    warmup_steps: int = 200
    """Steps of linear warm-up; a cosine to zero follows."""
    gradient_norm: float = 1.0
    """Gradients are clipped to this norm."""
    average_decay: float = 0.998
    """Decay of the moving average of the weights, which is saved."""
    checkpoint_seconds: float = 60.0
    """Time between checkpoints [s]."""
    shards: int = 1
    """Independent parts of a step's batch, each as large as the configuration says; processes share them."""
    log_every: int = 20
    """Steps between lines of the log."""
    recalibration: int = 64
    """Batches that measure the statistics of BatchNorm for the averaged weights, after the last step."""
    tensorboard: bool = False
    """Also write the log for TensorBoard, which must be installed."""
    mixed: bool = False
    """Multiply in bfloat16: in encoders and transformers, and on a GPU in the kernel of distances."""
    device: str = "cpu"
    """Device of network and samples: `cpu`, `cuda`, `cuda:1`. Another kind of device draws other samples."""
    seed: int = 0
    """Seed of initial weights and samples."""


@dataclass(frozen=True)
class TrainConfig(Checked):
    """Main training."""

    schedule: ScheduleConfig = ScheduleConfig()
    losses: LossConfig = LossConfig()
    augmentation: AugmentationConfig = AugmentationConfig()
    hands_per_step: int = 4
    """Hands in a shard of a step's batch."""
    samples_per_hand: int = 4
    """Grasps of each of these hands."""
    by_count: float = 0.0
    """Hands are drawn in proportion to the number of their grasps to this power; at 0 each as often as any other."""
    columns: int = 48
    """Object points to which a step predicts distances; inference uses all."""
    freeze_hand_encoder: bool = True
    """Keep a pretrained or given hand encoder as it is. Source: paper section III-C."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(hands_per_step=self.hands_per_step, samples_per_hand=self.samples_per_hand, columns=self.columns)
        if not 0 <= self.by_count <= 1:
            raise OptionError(f"by_count is {self.by_count}; give 0 to draw all hands equally often, 1 to draw them by their "
                              "grasps, or a number between")


@dataclass(frozen=True)
class PlacementConfig(Checked):
    """Training of the placement prior alone. Source: ours."""

    schedule: ScheduleConfig = ScheduleConfig(steps=1_300)
    augmentation: AugmentationConfig = AugmentationConfig()
    hands_per_step: int = 8
    samples_per_hand: int = 12
    by_count: float = 0.5


@dataclass(frozen=True)
class PretrainConfig(Checked):
    """Configuration-invariant pretraining of the hand encoder."""

    schedule: ScheduleConfig = ScheduleConfig(steps=3_000)
    hands_per_step: int = 4
    """Hands in a shard of a step's batch."""
    samples_per_hand: int = 4
    """Pairs of poses of each of these hands."""
    temperature: float = 0.1
    """Temperature tau of the contrastive loss. Source: paper section III-B."""
    sharpness: float = 10.0
    """Factor lambda in the tanh weights [1/m]. Source: paper section III-B."""
    rotation: float = math.radians(15)
    """Largest rotation between the two clouds' wrists, for networks that know the placement [rad]; others are pretrained with
    the tilt of their training. Source: ours."""


@dataclass(frozen=True)
class MotionConfig(Checked):
    """Pretraining of the z that encodes how hands move."""

    schedule: ScheduleConfig = ScheduleConfig(steps=5_000)
    augmentation: AugmentationConfig = AugmentationConfig()
    hands_per_step: int = 4
    """Hands in a shard of a step's batch."""
    samples_per_hand: int = 16
    """Pairs of poses of each of these hands."""
    divergence: float = 1e-5
    """Weight of the divergence of z from N(0, I) [m/nat]; main training weighs it more."""
