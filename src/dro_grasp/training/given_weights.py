"""Training that begins with given weights: what is taken from them, and what is refused."""

from __future__ import annotations

from torch import nn

from dro_grasp.errors import WeightsError
from dro_grasp.models.network import DistanceNetwork

NAMED = 4
"""Tensors that an error names one by one."""


def take_initial(model: DistanceNetwork, initial: DistanceNetwork) -> None:
    """Copy all weights of a network of the same configuration.

    Raises:
        WeightsError: The configurations differ. Settings such as the frame change what the weights mean, but no shape.
    """
    if other := model.config.differences(initial.config):
        told = ", ".join(f"{name} {mine} instead of {theirs}" for name, (mine, theirs) in other.items())
        raise WeightsError(f"the initial weights '{initial.name}' have another configuration than is asked for: {told}; train "
                           "with theirs, which `train --initial` does without --preset and --latent")
    model.load_state_dict(initial.state_dict())


def take_weights(model: nn.Module, given: nn.Module, name: str) -> None:
    """Copy the weights of a part of another network; `name` is that network's.

    Raises:
        WeightsError: The two differ in a tensor's name or shape.
    """
    ours, theirs = model.state_dict(), given.state_dict()
    wrong = [f"{key} is missing" for key in ours if key not in theirs]
    wrong += [f"{key} has no place" for key in theirs if key not in ours]
    wrong += [f"{key} has shape {tuple(theirs[key].shape)}, not {tuple(value.shape)}" for key, value in ours.items()
              if key in theirs and theirs[key].shape != value.shape]
    if wrong:
        more = f", and {len(wrong) - NAMED} more" if len(wrong) > NAMED else ""
        raise WeightsError(f"weights '{name}' do not fit this network: {', '.join(wrong[:NAMED])}{more}; train with the "
                           "configuration of these weights")
    model.load_state_dict(theirs)


def take_pretrained(model: DistanceNetwork, pretrained: DistanceNetwork) -> None:
    """Copy the hand encoder, and the motion where z moves the hand.

    Raises:
        WeightsError: They do not fit, or there is a pretrained motion and z does not move the hand.
    """
    if pretrained.config.neighbours != model.config.neighbours:
        raise WeightsError(f"the hand encoder of '{pretrained.name}' sees {pretrained.config.neighbours} neighbours of each "
                           f"point, this network at {model.config.neighbours}; pretrain with the network that is trained")
    take_weights(model.hand_encoder, pretrained.hand_encoder, pretrained.name)
    if pretrained.motion is not None and model.motion is None:
        raise WeightsError(f"weights '{pretrained.name}' hold a pretrained motion, but z does not move the hand in this "
                           "network; train in frame 'palm' (--preset multi)")
    if pretrained.motion is not None and model.motion is not None:
        take_weights(model.motion, pretrained.motion, pretrained.name)
