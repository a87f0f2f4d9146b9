"""isaac_grasp files, format version 1.0.

Source: documentation of isaac_grasp files in Isaac Sim (grasp editor) and Isaac ROS.
"""

from __future__ import annotations

from dro_grasp.export.contents import Frame, by_joint, comment, confidence, plain, postures, yaml_text
from dro_grasp.export.formats import ExportJob
from dro_grasp.grasps.batch import GraspBatch

NO_CONFIDENCE = 0.5
"""Confidence of a grasp without a score: neither good nor bad (ours). The documented format lists the entry for every grasp,
and readers may rely on it."""


def isaac_grasp(grasps: GraspBatch, frame: Frame) -> str:
    """An isaac_grasp YAML file of grasps of one object, with pregrasps."""
    position, quaternion = frame.place(grasps)
    pregrasp = postures(grasps)["pregrasp"]
    entries, unknown = {}, 0
    for i in range(len(grasps)):
        w, *xyz = plain(quaternion[i])
        known = confidence(grasps, i)
        unknown += known is None
        entries[f"grasp_{i}"] = {
            "confidence": NO_CONFIDENCE if known is None else known, "position": plain(position[i]),
            "orientation": {"w": w, "xyz": xyz}, "cspace_position": by_joint(grasps, grasps.joints[i]),
            "pregrasp_cspace_position": by_joint(grasps, pregrasp[i]),
        }
    content = {"format": "isaac_grasp", "format_version": 1.0, "object_frame_link": frame.name_for(grasps),
               "gripper_frame_link": grasps.wrist_link, "grasps": entries}
    note = f"# {unknown} of {len(grasps)} grasps have no score: their confidence {NO_CONFIDENCE} stands for unknown.\n"
    return comment(grasps, frame) + (note if unknown else "") + yaml_text(content)


def content(job: ExportJob) -> bytes:
    """One object's file."""
    return isaac_grasp(job.grasps, job.frame).encode()
