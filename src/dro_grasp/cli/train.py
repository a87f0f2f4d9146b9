"""`dro-grasp pretrain` and `dro-grasp train`: weights from a bundle."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from dro_grasp.cli.output import optional, print_json, print_table

if TYPE_CHECKING:
    from dro_grasp.models.network import NetworkConfig

Flag = tyro.conf.FlagCreatePairsOff[bool]


def network_config(size: str, latent: int | None, **changes: Any) -> NetworkConfig:
    """The network configuration of a size, with another number of latents if one is given, and other changes.

    Raises:
        OptionError: The number is not positive.
    """
    import dataclasses

    from dro_grasp.errors import OptionError
    from dro_grasp.models.network import NetworkConfig

    network = NetworkConfig.slim() if size == "slim" else NetworkConfig.paper()
    if latent is not None and latent < 1:
        raise OptionError(f"latent is {latent}; z needs at least one number")
    return dataclasses.replace(network, latent=network.latent if latent is None else latent, **changes)


@dataclass(frozen=True)
class Pretrain:
    """Pretrain the hand encoder so that a point keeps its features whatever the joints.

    Example: dro-grasp pretrain --bundle bundle.safetensors --run-folder runs/pre --output pretrained.safetensors
    """

    bundle: Path
    """Bundle from `dro-grasp dataset bundle`."""
    run_folder: Path
    """Folder for log and checkpoints; a run in it is taken up. Its parent must exist."""
    output: Path
    """Weights file to write."""
    size: Literal["slim", "paper"] = "slim"
    """Network size."""
    latent: Annotated[int | None, optional("N", "the size's")] = None
    """Numbers in z."""
    latent_form: Literal["kernel", "motion"] = "kernel"
    """With `motion`, z also learns to say how hands move, after the encoder and in a folder of its own in the run folder."""
    steps: int = 3000
    """Optimiser steps."""
    motion_steps: int = 5000
    """Those of the motion."""
    minutes: Annotated[float | None, optional("MINUTES", "no limit")] = None
    """Time limit of each; the learning rate follows whichever of steps and time is further on."""
    shards: int = 1
    """Independent parts of a step's batch, of 16 samples each; processes that torchrun starts share them out."""
    tensorboard: Flag = False
    """Also write the log for TensorBoard."""
    device: Annotated[str, optional("DEVICE", "cuda where there is one, else cpu")] = "auto"
    """Where to compute: cpu, cuda, or cuda:1."""
    seed: int = 0
    """Seed of everything."""
    json: Flag = False
    """Print one JSON object at the end."""

    def run(self) -> int:
        """Pretrain, save, and report the matching rank."""
        import dataclasses

        import torch

        from dro_grasp.datasets.bundle.training_file import load_bundle
        from dro_grasp.devices import choose_device
        from dro_grasp.evaluation.correspondence import matching_rank
        from dro_grasp.files import check_output
        from dro_grasp.models.checkpoints import save_weights
        from dro_grasp.training.config import AugmentationConfig, MotionConfig, PretrainConfig, ScheduleConfig
        from dro_grasp.training.pretraining import pretrain, pretrain_motion
        from dro_grasp.training.processes import is_first
        from dro_grasp.training.samples import SampleSource

        check_output(self.output)
        bundle = load_bundle(self.bundle)
        network = network_config(self.size, self.latent, latent_form=self.latent_form)
        schedule = ScheduleConfig(
            steps=self.steps, minutes=self.minutes, shards=self.shards, tensorboard=self.tensorboard,
            device=choose_device(self.device), seed=self.seed,
        )
        model = pretrain(bundle, network, PretrainConfig(schedule=schedule), self.run_folder)
        if self.latent_form == "motion":
            motion = MotionConfig(dataclasses.replace(schedule, steps=self.motion_steps))
            model = pretrain_motion(model, bundle, motion, self.run_folder / "motion")
        if not is_first():
            return 0
        about = how_long(self.run_folder) | {"stage": "pretraining", "data": bundle.summary()}
        save_weights(model, self.output, about)
        source = SampleSource(bundle, network, AugmentationConfig())
        ranks = matching_rank(model.hand_encoder, source, torch.Generator().manual_seed(1))
        report = {"output": str(self.output), "steps": about["steps"], "mean_rank": ranks, "chance": network.n_hand / 2}
        if self.json:
            print_json(report)
        else:
            print_table("mean rank of each point's counterpart", ["hand", "rank"], [list(i) for i in ranks.items()],
                        note=f"1 is perfect, {network.n_hand / 2:.0f} is chance; weights: {self.output}")
        return 0


@dataclass(frozen=True)
class Train:
    """Train the D(R,O) network on a bundle; a stopped run goes on where it was.

    Example: dro-grasp train --bundle bundle.safetensors --run-folder runs/main --pretrained pretrained.safetensors
    --output my_weights.safetensors
    """

    bundle: Path
    """Bundle from `dro-grasp dataset bundle`."""
    run_folder: Path
    """Folder for log and checkpoints; a run in it is taken up. Its parent must exist."""
    output: Path
    """Weights file to write."""
    pretrained: Annotated[str | None, optional("PATH", "none")] = None
    """Weights from `dro-grasp pretrain`; without them the hand encoder is trained along."""
    initial: Annotated[str | None, optional("NAME|PATH", "none")] = None
    """Weights to go on from: fine-tunes them on the bundle. The hand encoder stays as it is in them."""
    size: Literal["slim", "paper"] = "slim"
    """Network size."""
    steps: int = 10_000
    """Optimiser steps."""
    minutes: Annotated[float | None, optional("MINUTES", "no limit")] = None
    """Time limit; the learning rate follows whichever of steps and time is further on."""
    shards: int = 1
    """Independent parts of a step's batch, of 16 samples each; processes that torchrun starts share them out."""
    tensorboard: Flag = False
    """Also write the log for TensorBoard."""
    learning_rate: float = 1e-3
    """Peak of the learning rate."""
    prior: Literal["standard", "learned", "flow"] = "standard"
    """What z is drawn from: N(0, I), the paper's form, or a Gaussian or a flow learned from hand and object."""
    latent: Annotated[int | None, optional("N", "the size's")] = None
    """Numbers in z."""
    latent_form: Literal["kernel", "motion"] = "kernel"
    """What z does: it enters the kernel alone, the paper's form, or also moves the placed open hand."""
    divergence: float = 0.01
    """Weight of the KL term."""
    divergence_warmup: float = 0.0
    """Share of the schedule over which that weight grows from zero."""
    free_bits: float = 0.0
    """KL of each latent dimension that costs nothing [nat]."""
    samples_per_hand: int = 4
    """Grasps of each of the four hands in a part of a step's batch."""
    columns: int = 48
    """Object points to which distances are predicted in a step; a GPU affords 128."""
    mixed: Flag = False
    """Multiply in bfloat16 where that is safe; for GPUs."""
    partial: float = 0.0
    """Share of samples with half of the object cut away."""
    device: Annotated[str, optional("DEVICE", "cuda where there is one, else cpu")] = "auto"
    """Where to compute: cpu, cuda, or cuda:1."""
    validation: Annotated[Path | None, optional("PATH", "no errors")] = None
    """Bundle of grasps that are not trained on, of which the weights' distance errors are reported in the end."""
    validation_samples: int = 400
    """Of these, for each hand."""
    seed: int = 0
    """Seed of everything."""
    json: Flag = False
    """Print one JSON object at the end."""

    def run(self) -> int:
        """Train and save."""
        import dataclasses

        from dro_grasp.datasets.bundle.training_file import load_bundle
        from dro_grasp.devices import choose_device
        from dro_grasp.evaluation.distance_error import distance_errors
        from dro_grasp.files import check_output
        from dro_grasp.models.checkpoints import load_weights, save_weights
        from dro_grasp.training.config import AugmentationConfig, LossConfig, ScheduleConfig, TrainConfig
        from dro_grasp.training.loop import train
        from dro_grasp.training.processes import is_first

        check_output(self.output)
        bundle = load_bundle(self.bundle)
        validation = None if self.validation is None else load_bundle(self.validation)
        pretrained, initial = (None if name is None else load_weights(name) for name in (self.pretrained, self.initial))
        config = TrainConfig(
            schedule=ScheduleConfig(
                steps=self.steps, minutes=self.minutes, shards=self.shards, tensorboard=self.tensorboard,
                learning_rate=self.learning_rate, mixed=self.mixed, device=choose_device(self.device), seed=self.seed,
            ),
            samples_per_hand=self.samples_per_hand, columns=self.columns,
            losses=LossConfig(
                divergence=self.divergence, divergence_warmup=self.divergence_warmup, free_bits=self.free_bits),
            augmentation=AugmentationConfig(partial=self.partial),
        )
        network = network_config(self.size, self.latent, prior=self.prior, latent_form=self.latent_form)
        model = train(bundle, network, config, self.run_folder, pretrained, name=self.output.stem, initial=initial)
        if not is_first():
            return 0
        about = how_long(self.run_folder) | {
            "stage": "training", "pretrained": self.pretrained is not None, "initial": self.initial, "data": bundle.summary(),
        }
        save_weights(model, self.output, about)
        errors = [] if validation is None else distance_errors(load_weights(self.output), validation, self.validation_samples)
        report = {"output": str(self.output), "steps": about["steps"], "log": str(self.run_folder / "log.jsonl")}
        if self.json:
            print_json(report | {"distance_errors": [dataclasses.asdict(e) for e in errors]})
            return 0
        print_table("training", ["steps", "weights", "log"], [[report["steps"], report["output"], report["log"]]])
        if errors:
            rows = [[e.hand, 1e3 * e.posterior, 1e3 * e.prior, e.divergence] for e in errors]
            print_table("distance error", ["hand", "posterior z [mm]", "prior z [mm]", "divergence [nat]"], rows)
        return 0


def how_long(run_folder: Path) -> dict[str, int]:
    """Steps and seconds that a run took, whichever of its limits ended it."""
    from dro_grasp.training.runs import last_logged

    last = last_logged(run_folder)
    return {"steps": int(last["step"]), "seconds": round(last["seconds"])}
