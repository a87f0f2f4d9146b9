"""From nothing to weights of one's own: data for a hand, a bundle, pretraining, training. Minutes here, hours in earnest."""

from pathlib import Path
from tempfile import TemporaryDirectory

from dro_grasp.cli.main import main as dro_grasp

COMMANDS = (
    "synthesize --hand gripper3 --object can sphere --grasps 20 --output @data",
    "dataset info @data",
    "dataset bundle @data --output @bundle.safetensors",
    "pretrain --bundle @bundle.safetensors --run-folder @pre --output @pretrained.safetensors --steps 3",
    "train --bundle @bundle.safetensors --run-folder @main --pretrained @pretrained.safetensors --output @mine.safetensors "
    "--steps 3",
    "generate --hand gripper3 --object torus --weights @mine.safetensors --num 4",
)

# Worker processes read this file as well, and must not start all over.
if __name__ == "__main__":
    with TemporaryDirectory() as name:
        for command in COMMANDS:
            print(f"$ dro-grasp {command}")
            assert dro_grasp(command.replace("@", f"{Path(name)}/").split()) == 0
