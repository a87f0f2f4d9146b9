"""Import grasps of other projects: match their hands, objects and joints with ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from dro_grasp.datasets.collections.foreign_files import ForeignGrasp, Format, in_order, read_foreign
from dro_grasp.errors import ObjectError, OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import with_sources
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object


def import_grasps(
    paths: Sequence[Path], kind: Format, hands: Mapping[str, str], obj: str | None = None
) -> tuple[dict[str, GraspBatch], dict[str, str]]:
    """Read other projects' files.

    Args:
        paths: The files.
        kind: Their project.
        hands: Our names or paths of hands, by the names in the files; the entry '' stands for all others.
        obj: Object of all grasps, for files that name it otherwise or not at all.

    Returns:
        Grasps by hand, and why objects are missing, by their names.

    Raises:
        OptionError: No file is given, or neither a file nor the arguments name its hand or object.
        HandError: A hand cannot be loaded.
        GraspFileError: A file cannot be read, or its grasps are of other joints.
    """
    if not paths:
        raise OptionError(f"no file to import was given; name at least one {kind} file")
    groups: dict[tuple[str, str, float], list[ForeignGrasp]] = {}
    for path in paths:
        for grasp in read_foreign(path, kind):
            hand = hands.get(grasp.hand, hands.get("") or grasp.hand)
            if not hand:
                raise OptionError(f"{path} does not name its hand; name it with --hands")
            if not (obj or grasp.object):
                raise OptionError(f"{path} does not name its object; name it with --object")
            groups.setdefault((hand, obj or grasp.object, grasp.scale), []).append(grasp)
    batches: dict[str, list[GraspBatch]] = {}
    missing: dict[str, str] = {}
    for (hand, name, scale), grasps in groups.items():
        try:
            batches.setdefault(hand, []).append(_batch(hand, name, scale, grasps, kind))
        except ObjectError as error:
            missing[name] = str(error)
    return {hand: GraspBatch.concatenate(parts) for hand, parts in batches.items() if parts}, missing


def _batch(hand_name: str, obj_name: str, scale: float, grasps: list[ForeignGrasp], origin: str) -> GraspBatch:
    """Grasps of one hand on one object."""
    hand, obj = load_hand(hand_name), load_object(obj_name, scale=scale)
    T = torch.from_numpy(np.stack([grasp.T_object_wrist for grasp in grasps])).float()
    q = torch.tensor([in_order(grasp, hand.tree.moving_names, hand.tree.joint_names) for grasp in grasps])
    made = GraspBatch.create(hand, obj, T, q, provenance=f"imported from {origin}")
    return with_sources(made, hand_name, obj_name, scale)
