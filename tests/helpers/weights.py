"""Untrained weights, small and seeded, for tests of everything around the network."""

from __future__ import annotations

from pathlib import Path


def untrained_weights(folder: Path) -> Path:
    from dro_grasp.network.checkpoints import save_weights
    from dro_grasp.network.network import untrained_network
    from dro_grasp.network.presets import NetworkConfig

    path = folder / "untrained.safetensors"
    config = NetworkConfig(
        n_hand=96, n_object=64, width=32, encoder_widths=(16, 32), neighbours=8, attention_hidden=32, latent=8,
        latent_widths=(16, 32), latent_head=(32, 32), latent_neighbours=8, kernel_hidden=(32, 16), frame="palm",
        placement_width=32,
    )
    save_weights(untrained_network(config, seed=0), path)
    return path
