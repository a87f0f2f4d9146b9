"""A source of yours: a function of wrist poses and joints, and one entry, and the package refines, checks and ranks its grasps.

In the benchmark: `dro-grasp benchmark --methods 09_your_method:PinchFromAbove auto --hands barrett --stages returned`
"""

import torch

import dro_grasp as dro


class PinchFromAbove:
    """A class without arguments, with `predict`."""

    def predict(self, hand: dro.Hand, obj: dro.ObjectModel, num: int, seed: int) -> dro.GraspBatch:
        """Half-closed hands above the object, turned at random about the vertical."""
        angle = 2 * torch.pi * torch.rand(num, generator=torch.Generator().manual_seed(seed))
        above = -hand.palm_direction_wrist  # this axis of the wrist points up
        side = torch.nn.functional.normalize(torch.linalg.cross(above, torch.tensor([0.3, 0.5, 0.8])), dim=0)
        roll = torch.eye(3).repeat(num, 1, 1)
        roll[:, 0, 0], roll[:, 0, 1], roll[:, 1, 0], roll[:, 1, 1] = angle.cos(), -angle.sin(), angle.sin(), angle.cos()
        poses = torch.eye(4).repeat(num, 1, 1)  # of the wrist, in the object's frame [m]
        poses[:, :3, :3] = roll @ torch.stack([side, torch.linalg.cross(above, side), above])
        top = torch.tensor([*obj.centre_of_mass[:2], float(obj.cloud[:, 2].max())]).float()
        poses[:, :3, 3] = top - poses[:, :3, :3] @ hand.grasp_centre_wrist
        joints = hand.canonical_joints(0.45).repeat(num, 1)  # (num n_dof) [rad or m]
        return dro.GraspBatch.create(hand, obj, poses, joints, seed=seed, provenance="pinch from above")


dro.register_source("pinch", PinchFromAbove)

if __name__ == "__main__":
    hand, obj, predictor = dro.load_hand("barrett"), dro.load_object("can"), dro.GraspPredictor()
    for source in ("pinch", "start", "auto"):
        for refine in (False, True):
            grasps = predictor.predict(hand, obj, 8, refine=refine, source=source)
            held = {rules: int(dro.simulate(hand, obj, grasps, rules).success.sum()) for rules in ("strict", "carry")}
            how = "finished" if refine else "as proposed"
            print(f"{source:5} {how:11} of 8 grasps, {held['strict']} hold under strict, {held['carry']} under carry")
