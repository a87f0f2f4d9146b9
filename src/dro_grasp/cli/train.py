"""`dro-grasp pretrain` and `dro-grasp train`: weights from a bundle."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from dro_grasp.cli.inputs import Flag, optional
from dro_grasp.cli.output import print_result, print_table
from dro_grasp.errors import OptionError
from dro_grasp.files import check_output
from dro_grasp.kinds import require_positive

if TYPE_CHECKING:
    from dro_grasp.network.network import DistanceNetwork
    from dro_grasp.network.presets import NetworkConfig
    from dro_grasp.training.config import ScheduleConfig
    from dro_grasp.training.data.bundle.training_file import Bundle
    from dro_grasp.training.measures import DistanceError


@dataclass(frozen=True, kw_only=True)
class Stage:
    """Options of both stages of training."""

    bundle: Path  # Bundle from `dro-grasp dataset bundle`.
    run_folder: Path  # Folder for log and checkpoints; created if missing. A run in it is resumed.
    output: Path  # Weights file to write.
    preset: Annotated[
        Literal["slim", "paper", "paper-slim", "multi"] | None,
        tyro.conf.arg(metavar="{slim,paper,paper-slim,multi}", help_behavior_hint="(default: multi)"),
    ] = None
    """Form of the network. multi, also called slim: that of the default weights, narrow, with a placement. paper: the paper's.
    paper-slim: the paper's, as narrow as multi."""
    initial: Annotated[str | None, optional("NAME|PATH", "none")] = None
    """Weights to start from, which decide the form of the network. `train` keeps their hand encoder as it is."""
    learning_rate: float = 1e-3  # Peak of the learning rate.
    minutes: Annotated[float | None, optional("MINUTES", "no limit")] = None
    """Time limit [min]; in `pretrain`, of each part. The learning rate follows steps or time, whichever is further on."""
    shards: int = 1  # Independent parts of a step's batch; the processes of torchrun share them.
    tensorboard: Flag = False  # Also write the log for TensorBoard, which must be installed.
    device: Annotated[str, optional("DEVICE", "cuda where there is one, else cpu")] = "auto"
    """Where to compute: cpu, cuda, or cuda:1."""
    seed: int = 0  # Seed of everything.
    json: Flag = False  # Print one JSON object at the end.

    def network(self, initial: DistanceNetwork | None) -> NetworkConfig:
        """The configuration of the preset, else of the initial weights, else of `multi`."""
        from dro_grasp.network.presets import NetworkConfig

        given = None if initial is None or self.preset is not None else initial.config
        return given or NetworkConfig.preset(self.preset or "multi")

    def schedule(self, **more: Any) -> ScheduleConfig:
        """The schedule, which can be carried out here."""
        from dro_grasp.devices import choose_device
        from dro_grasp.training.config import ScheduleConfig
        from dro_grasp.training.runs import check_schedule

        schedule = ScheduleConfig(
            learning_rate=self.learning_rate, minutes=self.minutes, shards=self.shards, tensorboard=self.tensorboard,
            device=choose_device(self.device), seed=self.seed, **more)
        check_schedule(schedule)
        return schedule


@dataclass(frozen=True, kw_only=True)
class Pretrain(Stage):
    """Pretrain the hand encoder so that a point's features do not depend on the joints.

    Example: dro-grasp pretrain --bundle bundle.safetensors --run-folder runs/pre --output pretrained.safetensors
    """

    steps: int = 3000  # Optimiser steps.
    motion_steps: int = 5000
    """Optimiser steps of the motion, which is learned after the encoder, in a folder of its own in the run folder."""

    def run(self) -> int:
        """Pretrain, save, and report the matching rank."""
        import dataclasses

        import torch

        from dro_grasp.network.checkpoints import history_of, load_weights, locate_weights, save_weights
        from dro_grasp.provenance import made_by
        from dro_grasp.training.config import AugmentationConfig, MotionConfig, PretrainConfig
        from dro_grasp.training.data.bundle.training_file import load_bundle
        from dro_grasp.training.measures import matching_rank
        from dro_grasp.training.pretraining import pretrain, pretrain_motion
        from dro_grasp.training.runs import how_long, is_first
        from dro_grasp.training.samples import SampleSource

        check_output(self.output, ".safetensors")
        require_positive(motion_steps=self.motion_steps)
        initial = None if self.initial is None else load_weights(self.initial)
        network = self.network(initial)
        schedule = self.schedule(steps=self.steps)
        bundle = load_bundle(self.bundle)
        config = PretrainConfig(schedule)
        motion = MotionConfig(dataclasses.replace(schedule, steps=self.motion_steps))
        model = pretrain(bundle, network, config, self.run_folder, initial=initial)
        if network.placed:
            model = pretrain_motion(model, bundle, motion, self.run_folder / "motion")
        if not is_first():
            return 0
        settings: dict[str, Any] = {"encoder": config}
        took = how_long(self.run_folder)
        if network.placed:
            settings["motion"] = motion
            further = how_long(self.run_folder / "motion")
            took |= {"motion_steps": further["steps"], "seconds": took["seconds"] + further["seconds"]}
        source = SampleSource(bundle, network, AugmentationConfig())
        ranks = matching_rank(model.hand_encoder, source, torch.Generator().manual_seed(1))
        about = took | {
            "stage": "pretraining", **made_by(), "initial": self.initial,
            "data": bundle.summary() | {"fingerprint": bundle.fingerprint},
            "samples": took["steps"] * schedule.shards * config.hands_per_step * config.samples_per_hand,
            "settings": {name: dataclasses.asdict(part) for name, part in settings.items()}, "metrics": {"mean_rank": ranks},
        }
        save_weights(model, self.output, about, [] if self.initial is None else history_of(locate_weights(self.initial)))
        report = {"output": str(self.output), "steps": about["steps"], "mean_rank": ranks, "chance": network.n_hand / 2}
        print_result(self.json, report, "mean rank of each point's counterpart", ["hand", "rank"], [*ranks.items()],
                     f"1 is perfect, {network.n_hand / 2:.0f} is chance; weights: {self.output}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Train(Stage):
    """Train the D(R,O) network on a bundle; a stopped run resumes from its last checkpoint.

    Example: dro-grasp train --bundle bundle.safetensors --run-folder runs/main --pretrained pretrained.safetensors
    --output my_weights.safetensors
    """

    part: Literal["all", "placement"] = "all"
    """placement: train only the placement prior of --initial, which shares no parameters with the rest. A step takes 96 grasps,
    of hands in proportion to the square root of their number of grasps. Options of losses, samples and columns do not apply."""
    pretrained: Annotated[str | None, optional("PATH", "none")] = None
    """Weights from `dro-grasp pretrain`. Without them, and without --initial, the hand encoder is trained too."""
    steps: Annotated[int | None, optional("N", "10000, or 1300 of the placement prior")] = None  # Optimiser steps.
    losses: Literal["ours", "release"] = "ours"
    """Weights of the losses and form of the KL divergence: ours, or those of the official release."""
    divergence: Annotated[float | None, optional("WEIGHT", "0.01")] = None
    """KL weight; a lower value lets z carry more information."""
    samples_per_hand: int = 4  # Grasps of each of the four hands in a shard.
    by_count: float = 0.0
    """Power of the number of grasps with which hands are drawn; 0 draws all hands equally often."""
    columns: int = 48  # Object points to which a step predicts distances; a GPU affords 128.
    mixed: Flag = False  # Multiply in bfloat16; for GPUs.
    partial: float = 0.0  # Share of samples with half of the object cut away.
    validation: Annotated[Path | None, optional("PATH", "no errors")] = None
    """Bundle of grasps that are not trained on. The distance errors on them are reported at the end."""
    validation_samples: int = 400  # Validation grasps of each hand.

    def run(self) -> int:
        """Train and save."""
        import dataclasses

        from dro_grasp.network.checkpoints import history_of, load_weights, locate_weights
        from dro_grasp.provenance import made_by
        from dro_grasp.training.config import LOSSES, AugmentationConfig, PlacementConfig, TrainConfig
        from dro_grasp.training.data.bundle.training_file import load_bundle
        from dro_grasp.training.loop import train, train_placement
        from dro_grasp.training.runs import how_long, is_first

        check_output(self.output, ".safetensors")
        require_positive(validation_samples=self.validation_samples)
        if self.part == "placement" and (self.initial is None or self.pretrained is not None):
            raise OptionError("--part placement trains the placement prior of given weights further: name them with --initial, "
                              "and leave out --pretrained")
        if self.initial is not None and self.pretrained is not None:
            raise OptionError(f"--initial {self.initial} and --pretrained {self.pretrained} both give the hand encoder; leave "
                              "one of them out")
        given = [name for name in (self.initial, self.pretrained) if name is not None]
        pretrained, initial = (None if name is None else load_weights(name) for name in (self.pretrained, self.initial))
        network = self.network(initial)
        losses = LOSSES[self.losses]
        if self.divergence is not None:
            losses = dataclasses.replace(losses, divergence=self.divergence)
        usual = PlacementConfig() if self.part == "placement" else TrainConfig()
        steps = usual.schedule.steps if self.steps is None else self.steps
        config: Any = TrainConfig(
            schedule=self.schedule(steps=steps, mixed=self.mixed),
            samples_per_hand=self.samples_per_hand, by_count=self.by_count, columns=self.columns, losses=losses,
            augmentation=AugmentationConfig(partial=self.partial),
        )
        bundle = load_bundle(self.bundle)
        validation = None if self.validation is None else load_bundle(self.validation)
        if self.part == "placement":
            assert initial is not None
            config = PlacementConfig(config.schedule, config.augmentation)
            model = train_placement(bundle, network, config, self.run_folder, initial, name=self.output.stem)
        else:
            model = train(bundle, network, config, self.run_folder, pretrained, name=self.output.stem, initial=initial)
        if not is_first():
            return 0
        took = how_long(self.run_folder)
        about = took | {
            "stage": "training" if self.part == "all" else self.part, **made_by(), "pretrained": self.pretrained is not None,
            "initial": self.initial, "data": bundle.summary() | {"fingerprint": bundle.fingerprint},
            "settings": dataclasses.asdict(config),
            "samples": took["steps"] * config.schedule.shards * config.hands_per_step * config.samples_per_hand,
        }
        history = [entry for name in given for entry in history_of(locate_weights(name))]
        errors = self._saved(model, about, history, validation)
        report = {"output": str(self.output), "steps": about["steps"], "log": str(self.run_folder / "log.jsonl")}
        values = report | {"distance_errors": [dataclasses.asdict(e) for e in errors]}
        print_result(self.json, values, "training", ["steps", "weights", "log"],
                     [[report["steps"], report["output"], report["log"]]])
        if errors and not self.json:
            rows = [[e.hand, 1e3 * e.posterior, 1e3 * e.prior, e.divergence] for e in errors]
            print_table("distance error", ["hand", "posterior z [mm]", "prior z [mm]", "divergence [nat]"], rows)
        return 0

    def _saved(
        self, model: DistanceNetwork, about: dict[str, Any], history: list[dict[str, Any]], validation: Bundle | None
    ) -> list[DistanceError]:
        """Save the weights; with a validation bundle, measure what was saved, which states the errors then."""
        from dataclasses import asdict

        from dro_grasp.network.checkpoints import load_weights, save_weights
        from dro_grasp.training.measures import distance_errors

        save_weights(model, self.output, about, history)
        if validation is None:
            return []
        errors = distance_errors(load_weights(self.output), validation, self.validation_samples)
        metrics = {"distance_errors": [asdict(error) for error in errors], "validation": validation.fingerprint}
        save_weights(model, self.output, about | {"metrics": metrics}, history)
        return errors
