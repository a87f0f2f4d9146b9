"""Statistics of BatchNorm for the averaged weights."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import nn


@torch.no_grad()
def recalibrate(model: nn.Module, forward: Callable[[], object], batches: int = 64) -> None:
    """Measure the statistics of BatchNorm for the averaged weights.

    The averages kept during training belong to other weights: with them the distance error in evaluation mode is
    twice that in training mode. Layers in evaluation mode, as in a frozen encoder, keep their statistics.

    Args:
        model: A model in training mode, with the averaged weights.
        forward: Passes the next batch of training data through it.
        batches: Number of batches that the statistics average over.
    """
    layers = [layer for layer in model.modules() if isinstance(layer, nn.BatchNorm1d) and layer.training]
    momenta = [layer.momentum for layer in layers]
    for layer in layers:
        layer.reset_running_stats()
        layer.momentum = None
    for _ in range(batches):
        forward()
    for layer, momentum in zip(layers, momenta, strict=True):
        layer.momentum = momentum
