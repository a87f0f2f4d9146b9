"""From nothing to weights of your own: synthesize, bundle, pretrain, train, predict. Minutes here, hours in earnest."""

from pathlib import Path
from tempfile import TemporaryDirectory

import dro_grasp as dro


def main(folder: Path) -> None:
    """Make data and weights in a folder, then grasp with them."""
    dro.synthesize_dataset(["gripper3"], ["can", "sphere"], 20, folder / "data", workers=2)
    for pair in dro.read_collection(folder / "data"):
        print(f"{len(pair.grasps)} grasps of {pair.object} by {pair.hand} hold under protocol 'carry'")
    bundle, _ = dro.make_bundle([folder / "data"], folder / "bundle.safetensors")

    network, schedule = dro.NetworkConfig.preset("slim"), dro.ScheduleConfig(steps=3)
    encoder = dro.pretrain(bundle, network, dro.PretrainConfig(schedule), folder / "pretraining")
    trained = dro.train(bundle, network, dro.TrainConfig(schedule), folder / "training", encoder)
    dro.save_weights(trained, folder / "mine.safetensors")

    predictor = dro.GraspPredictor(str(folder / "mine.safetensors"))
    grasps = predictor.predict(dro.load_hand("gripper3"), dro.load_object("torus"), num=4)
    print(f"{len(grasps)} grasps of a torus, with scores {[round(score, 2) for score in grasps.score.tolist()]}")


# Worker processes import this file, and must not start all over.
if __name__ == "__main__":
    with TemporaryDirectory() as name:
        main(Path(name))
