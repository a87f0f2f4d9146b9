"""Grasps as a table of comma-separated values."""

from __future__ import annotations

import csv
import io

from jaxtyping import Float
from torch import Tensor

from dro_grasp.export.contents import Frame, comment, plain, postures
from dro_grasp.export.formats import ExportJob
from dro_grasp.grasps.batch import GraspBatch


def csv_table(grasps: GraspBatch, frame: Frame) -> str:
    """One line per grasp: pose, score, energy, outcome and the joints of all postures, after comment lines."""
    position, quaternion = frame.place(grasps)
    joints = postures(grasps)
    text = io.StringIO()
    text.write(comment(grasps, frame))
    writer = csv.writer(text, lineterminator="\n")
    names = [f"{posture}:{joint}" for posture in joints for joint in grasps.joint_names]
    writer.writerow(["object", "x", "y", "z", "qw", "qx", "qy", "qz", "score", "energy", "success", "protocol",
                     "robustness", "fingers_in_contact", *names])
    for i in range(len(grasps)):
        writer.writerow([
            grasps.object[i], *plain(position[i]), *plain(quaternion[i]), _known(grasps.score[i]), _known(grasps.energy[i]),
            int(grasps.success[i]) if bool(grasps.evaluated[i]) else "", grasps.protocol[i],
            _known(grasps.robustness[i]), _known(grasps.fingers_in_contact[i]),
            *(value for values in joints.values() for value in plain(values[i])),
        ])
    return text.getvalue()


def _known(value: Float[Tensor, ""]) -> float | str:
    """A number, or an empty cell where it is unknown."""
    return plain(value[None])[0] if bool(value.isfinite()) else ""


def content(job: ExportJob) -> bytes:
    """One object's file."""
    return csv_table(job.grasps, job.frame).encode()
