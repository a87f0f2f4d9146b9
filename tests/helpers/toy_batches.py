"""Batches of made-up grasps of a hand of two joints."""

from __future__ import annotations

from types import SimpleNamespace

import torch

from dro_grasp.geometry.se3 import roma
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.simulation.outcome import Failure

HAND = SimpleNamespace(
    name="toy", sha256="a" * 64, tree=SimpleNamespace(link_names=("base", "tip"), joint_names=("j0", "j1"))
)
BALL = SimpleNamespace(name="ball", sha256="b" * 64, split="train")
CUBE = SimpleNamespace(name="cube", sha256="c" * 64, split=None)


def make(n: int, obj=BALL, seed: int = 0, **optional) -> GraspBatch:
    generator = torch.Generator().manual_seed(seed)
    T = torch.eye(4).repeat(n, 1, 1)
    quaternion = torch.randn(n, 4, generator=generator)
    T[:, :3, :3] = roma.unitquat_to_rotmat(quaternion / quaternion.norm(dim=-1, keepdim=True))
    T[:, :3, 3] = torch.randn(n, 3, generator=generator)
    joints = torch.randn(n, 2, generator=generator)
    return GraspBatch.create(HAND, obj, T, joints, seed=seed, provenance="test 1", **optional)


def evaluated(n: int, **optional) -> GraspBatch:
    trial = SimpleNamespace(
        success=torch.arange(n) % 2 == 0, displacement=torch.rand(n, 6), rotation=torch.rand(n, 6),
        penetration=torch.rand(n), protocol="dro/1", robustness=torch.full((n,), torch.nan),
        fingers_in_contact=torch.arange(n),
        reason=tuple("" if i % 2 == 0 else "slipped by 30 mm" for i in range(n)), contact_links=(("tip",),) * n,
        failure=tuple(None if i % 2 == 0 else Failure.SLIPPED for i in range(n)),
    )
    return make(n, **optional).with_trial(trial)
