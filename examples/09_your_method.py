"""A method of yours in the benchmark's table. Any function that returns wrist poses and joints will do.

Beside others: `dro-grasp benchmark --method 09_your_method:PinchFromAbove dro --hands barrett --objects can --stages returned`
"""

import torch

import dro_grasp as dro


def pinch_from_above(hand: dro.Hand, obj: dro.ObjectModel, num: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Yours: wrist poses (num 4 4) in the object's frame [m], and joints (num n_dof) [rad or m]."""
    generator = torch.Generator().manual_seed(seed)
    angle = 2 * torch.pi * torch.rand(num, generator=generator)
    above = -hand.palm_direction_wrist  # this axis of the wrist points up
    side = torch.linalg.cross(above, torch.tensor([0.3, 0.5, 0.8]), dim=0)
    wrist_axes = torch.stack([torch.nn.functional.normalize(side, dim=0), torch.linalg.cross(above, side / side.norm()), above])
    roll = torch.zeros(num, 3, 3)
    roll[:, 0, 0], roll[:, 0, 1], roll[:, 1, 0], roll[:, 1, 1] = angle.cos(), -angle.sin(), angle.sin(), angle.cos()
    roll[:, 2, 2] = 1
    poses = torch.eye(4).repeat(num, 1, 1)
    poses[:, :3, :3] = roll @ wrist_axes
    top = torch.tensor([*obj.centre_of_mass[:2], float(obj.cloud[:, 2].max())]).float()
    poses[:, :3, 3] = top - poses[:, :3, :3] @ hand.grasp_centre_wrist
    return poses, hand.canonical_joints(0.45).repeat(num, 1)


class PinchFromAbove:
    """What the benchmark needs: a class without arguments, with `predict`."""

    def predict(self, hand: dro.Hand, obj: dro.ObjectModel, num: int, seed: int) -> dro.GraspBatch:
        """Wrap the function."""
        poses, joints = pinch_from_above(hand, obj, num, seed)
        return dro.GraspBatch.create(hand, obj, poses, joints, seed=seed, provenance="pinch from above")


if __name__ == "__main__":
    hand, obj = dro.load_hand("barrett"), dro.load_object("can")
    for method in (PinchFromAbove(), dro.make_method("start"), dro.make_method("dro")):
        grasps = method.predict(hand, obj, 8, 0)
        held = {rules: int(dro.simulate(hand, obj, grasps, rules).success.sum()) for rules in ("dro", "strict")}
        print(f"{type(method).__name__:15} of 8 grasps, {held['dro']} hold under dro, {held['strict']} under strict")
