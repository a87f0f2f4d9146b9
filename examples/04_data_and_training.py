"""From nothing to weights of one's own: data for a hand, a bundle, pretraining, training. Minutes here, hours in earnest."""

from pathlib import Path
from tempfile import TemporaryDirectory

from dro_grasp.cli.main import main as dro_grasp

with TemporaryDirectory() as name:
    folder = Path(name)

    def run(command: str) -> None:
        """One command of the tool, with paths in the folder."""
        print(f"$ dro-grasp {command}")
        assert dro_grasp(command.replace("@", f"{folder}/").split()) == 0

    run("synthesize --hand gripper3 --object can sphere --grasps 20 --output @data")
    run("dataset info @data")
    run("dataset bundle @data --output @bundle.safetensors")
    run("pretrain --bundle @bundle.safetensors --run-folder @pre --output @pretrained.safetensors --steps 3")
    run("train --bundle @bundle.safetensors --run-folder @main --pretrained @pretrained.safetensors --output @mine.safetensors "
        "--steps 3")
    run("generate --hand gripper3 --object torus --weights @mine.safetensors --num 4")
