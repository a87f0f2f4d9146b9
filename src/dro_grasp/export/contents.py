"""What several formats say about grasps, and how they write it."""

from __future__ import annotations

import math
from typing import Any

import yaml
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.export.frame import Frame
from dro_grasp.grasps.batch import GraspBatch

LARGEST_SCORE = 30.0
"""Log-odds beyond which the confidence is 0 or 1 to all digits that are written (ours)."""


def postures(grasps: GraspBatch) -> dict[str, Float[Tensor, "n n_dof"]]:
    """Joints of pregrasp, grasp and squeeze, in the order in which a hand goes through them [rad or m].

    Raises:
        OptionError: A grasp states no pregrasp or squeeze.
    """
    if not bool(grasps.states_closing.all()):
        raise OptionError("these grasps have no pregrasp and squeeze; `dro-grasp export` makes them, and so does "
                          "`dro_grasp.complete(problem, grasps)`")
    return {"pregrasp": grasps.pregrasp_joints, "grasp": grasps.joints, "squeeze": grasps.squeeze_joints}


def confidence(grasps: GraspBatch, i: int) -> float | None:
    """Predicted probability that a grasp holds, the logistic function of its score; None without a score."""
    score = float(grasps.score[i])
    if math.isnan(score):
        return None
    return round(1 / (1 + math.exp(-max(-LARGEST_SCORE, min(LARGEST_SCORE, score)))), 6)


def comment(grasps: GraspBatch, frame: Frame) -> str:
    """Three lines that a reader of the file needs: hand, frame, units and the meaning of numbers."""
    return (
        f"# Grasps by hand '{grasps.hand}': poses of link '{grasps.wrist_link}' in {frame.sentence(grasps)}.\n"
        "# Metres and radians; quaternions by name or WXYZ. Joints are the independent ones; mimic joints follow them.\n"
        "# Score: predicted log-odds that the grasp holds; confidence is its logistic function. Energy: lower is better.\n"
    )


def by_joint(grasps: GraspBatch, joints: Float[Tensor, " n_dof"]) -> dict[str, float]:
    """Joint values by name."""
    return dict(zip(grasps.joint_names, plain(joints), strict=True))


def plain(values: Float[Tensor, " k"]) -> list[float]:
    """Numbers that read well: a ten-millionth is finer than any robot."""
    return [round(float(v), 7) for v in values]


def yaml_text(content: Any) -> str:
    """YAML in the order given, leaves on one line."""
    return yaml.dump(content, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=120)


class _Dumper(yaml.SafeDumper):
    """Without anchors, which other readers do not expect."""

    def ignore_aliases(self, data: Any) -> bool:
        return True
