"""Run trials of grasps: close the hand, push the object along six directions, see whether it stays; or close it alone.

Source: paper, evaluation metric details.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.devices import cores
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import CARRYING, PER_JOINT
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.conditions import draw
from dro_grasp.simulation.contacts import Penetration, contact_mask, count_fingers, find_contact_links, measure_penetration
from dro_grasp.simulation.outcome import LOST_DISTANCE, Failure, Measurements, TrialResult, verdict
from dro_grasp.simulation.piercing import pierced
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, Protocol
from dro_grasp.simulation.rollout import Rollout, rollouts, rollouts_of_all
from dro_grasp.simulation.scene import TrialScene, cached_scene, scene_of
from dro_grasp.simulation.worlds import Share, on_processor


@checked
def simulate(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol = DEFAULT_PROTOCOL, *,
    workers: int | None = None, progress: Callable[[int, int], None] | None = None, another: bool = False,
    device: str = "cpu", confirm: bool = True,
) -> TrialResult:
    """Evaluate grasps of one object in MuJoCo.

    Args:
        hand: The hand of the grasps.
        obj: Their object; it needs a mesh.
        grasps: The controller makes each pregrasp and squeeze that a grasp does not state.
        protocol: A name in PROTOCOLS, or a Protocol of your own.
        workers: Threads; all cores by default. The result does not depend on it.
        progress: Called with (grasps evaluated, grasps in all).
        another: Take the object although the grasps were made for one of other name and content.
        device: `cuda` runs many trials together by MuJoCo Warp (extra `gpu`), in single precision; few run on the processor.
        confirm: Let the processor judge again what holds on a device; what fails there, fails.

    Raises:
        ObjectError: The object is a bare point cloud, or not that of the grasps.
        HandError: The hand came without its description.
        GraspFileError: The grasps are of another hand.
        OptionError: The protocol does not exist, or the extra is missing.
    """
    scene_of(hand, obj, grasps, protocol)  # what has no trial at all is told first
    if not another:
        grasps.require_object(obj)
    result, = simulate_many(
        hand, [obj], [grasps], protocol, workers=workers, progress=progress, device=device, confirm=confirm)
    return replace(result, asked=grasps.asked)


def simulate_many(
    hand: Hand, objects: Sequence[ObjectModel], batches: Sequence[GraspBatch], protocol: str | Protocol = DEFAULT_PROTOCOL, *,
    workers: int | None = None, progress: Callable[[int, int], None] | None = None, device: str = "cpu", confirm: bool = True,
) -> list[TrialResult]:
    """The same for several objects, whoever their grasps were made for, together on a device."""
    scenes = [scene_of(hand, obj, grasps, protocol) for obj, grasps in zip(objects, batches, strict=True)]
    label, counts, results, done = scenes[0].protocol.label, [len(grasps) for grasps in batches], list[TrialResult](), 0
    for part, rollout in rollouts_of_all(scenes, hand, batches, workers, device=device):
        result = _evaluated(part, rollout, workers)
        if confirm and not on_processor(rollout.device):
            result = _confirmed(part, rollout, result, workers)
        results.append(result)
        done += len(part)
        if progress is not None:
            progress(done, sum(counts))
    whole = TrialResult.join(results, label)
    return [whole.rows(rows) for rows in torch.arange(sum(counts)).split(counts)]


def _evaluated(part: GraspBatch, rollout: Rollout, workers: int | None) -> TrialResult:
    """All trials of the grasps of a rollout."""
    penetration = Penetration.join([measure_penetration(scene, part[rows]) for scene, rows in rollout.parts()])
    result = run_trial(rollout, penetration)
    return result if rollout.scene.protocol.perturbations.trials == 1 else _repeated(
        rollout, part, result, penetration, workers)


def _confirmed(grasps: GraspBatch, rollout: Rollout, result: TrialResult, workers: int | None) -> TrialResult:
    """The outcome in which the processor has judged what holds."""
    judged = []
    for scene, rows in rollout.parts():
        own, found = grasps[rows], result.rows(torch.arange(rows.start, rows.stop))
        held, others = found.success.nonzero()[:, 0], (~found.success).nonzero()[:, 0]
        again = [_evaluated(part, other, workers) for part, other in rollouts(scene, scene.hand, own[held], workers)]
        judged.append(TrialResult.join([found.rows(others), *again], result.protocol).rows(torch.cat([others, held]).argsort()))
    return TrialResult.join(judged, result.protocol)


def record(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, index: int, protocol: str | Protocol = DEFAULT_PROTOCOL, *,
    stride: int = 10,
) -> tuple[Float[Tensor, "frames 4 4"], Float[Tensor, "frames n_dof"]]:
    """Frames of one grasp's trial: object poses in the wrist frame [m], and joints [rad or m]; errors as of `simulate`.

    It runs and ends as `simulate` does; of several trials under a protocol that perturbs, it is the one that `simulate`
    measures. There are `stride` time steps between two frames; the end of closing and of each force gets a frame in any case.
    """
    scene = scene_of(hand, obj, grasps, protocol)
    (grasp, rollout), = rollouts(scene, hand, grasps[index], workers=1, stride=stride)
    penetration = measure_penetration(scene, grasp)
    if shown := int(simulate(hand, obj, grasp, scene.protocol, workers=1, another=True).shown):
        conditions = draw(scene.protocol.perturbations, grasp).rows(slice(shown - 1, shown))
        rollout = Rollout(_scene_of_trial(scene, shown), grasp, workers=1, stride=stride, conditions=conditions)
    run_trial(rollout, penetration)
    joints, poses = (
        torch.from_numpy(np.concatenate(part).astype(np.float32)) for part in zip(*rollout.frames, strict=True))
    return poses, joints


def run_trial(rollout: Rollout, penetration: Penetration) -> TrialResult:
    """Close the hands of a rollout and push the objects."""
    hand, rules = rollout.scene.hand, rollout.scene.protocol
    closed = rollout.close()
    contacts = tuple(
        links for scene, rows in rollout.parts() for links in find_contact_links(scene, rollout.qpos[rows]))
    through = np.concatenate([pierced(scene, rollout.qpos[rows]) for scene, rows in rollout.parts()])
    penetration = replace(penetration, object=np.maximum(penetration.object, through))
    shift, turn = closed.shift(rollout.start), closed.turn(rollout.start)
    # A trial that has failed already needs no forces.
    failed = ((shift > min(rules.max_closing_shift, LOST_DISTANCE)) | (turn > rules.max_closing_rotation)
              | (penetration.object > rules.max_penetration) | (penetration.own > rules.max_self_penetration))
    displacement, rotation, stable = rollout.push(closed, ~failed)
    fingers = count_fingers(hand, contacts)
    return Measurements(penetration, shift, turn, contacts, fingers, stable, displacement, rotation).judged(rules)


def _repeated(
    rollout: Rollout, grasps: GraspBatch, first: TrialResult, penetration: Penetration, workers: int | None
) -> TrialResult:
    """The outcome with all trials of a protocol that perturbs, from the first; who penetrates too deep fails them all."""
    rules = rollout.scene.protocol.perturbations
    deep = torch.tensor([failure in {Failure.PENETRATION, Failure.SELF_PENETRATION} for failure in first.failure])
    others, rows = deep.nonzero()[:, 0], (~deep).nonzero()[:, 0]
    results = [replace(first.rows(others), robustness=torch.zeros(len(others)))]
    if len(rows):
        conditions, trials = draw(rules, grasps[rows]), [first.rows(rows)]
        counts = [(scene, int((~deep[part]).sum())) for scene, part in rollout.parts()]
        for begin, end in ((1, rules.trials - rules.coarse), (rules.trials - rules.coarse, rules.trials)):
            if begin == end:
                continue
            index, own = rows.repeat(end - begin), conditions.rows(slice((begin - 1) * len(rows), (end - 1) * len(rows)))
            shares = [Share(_scene_of_trial(scene, begin), count) for scene, count in counts if count] * (end - begin)
            other = Rollout(
                shares[0].scene, grasps[index], workers or cores(), conditions=own, device=rollout.device,
                shares=shares if len(counts) > 1 else ())
            trials.append(run_trial(other, penetration.rows(index.numpy())))
        results.append(verdict(TrialResult.join(trials, first.protocol), rules.trials, rules.needed))
    return TrialResult.join(results, first.protocol).rows(torch.cat([others, rows]).argsort())


def _scene_of_trial(scene: TrialScene, trial: int) -> TrialScene:
    """The scene of a trial: in the last ones the object has coarse parts."""
    rules = scene.protocol.perturbations
    fine = trial < rules.trials - rules.coarse
    return scene if fine else cached_scene(scene.hand, scene.obj.coarse, scene.protocol, scene.table)


def settle_many(
    hand: Hand, objects: Sequence[ObjectModel], batches: Sequence[GraspBatch], protocol: str | Protocol = DEFAULT_PROTOCOL, *,
    workers: int | None = None, device: str = "cpu"
) -> list[GraspBatch]:
    """The same grasps, relabelled with the poses of hand and object after closing; several objects together on a device.

    A joint above a link that touches the object takes the value it reached, held back by the contact, so that the
    label touches the surface. The other joints keep their values: closing would only drive them towards a fist. A
    grasp whose simulation is unstable keeps its label. Energies and depth stay those before settling; scores and
    outcomes are dropped. Errors are those of `simulate`.
    """
    scenes = [scene_of(hand, obj, grasps, protocol) for obj, grasps in zip(objects, batches, strict=True)]
    joints, poses = [batches[0].joints[:0]], [batches[0].T_object_wrist[:0]]
    for part, rollout in rollouts_of_all(scenes, hand, batches, workers, device=device):
        held_joints, T_object_wrist = held(part, rollout, torch.from_numpy(rollout.close().stable))
        joints.append(held_joints)
        poses.append(T_object_wrist)
    counts = [len(grasps) for grasps in batches]
    return [
        grasps.without(*PER_JOINT, *CARRYING, "score").without_trial().replace(T_object_wrist=T, joints=q)
        for grasps, T, q in zip(batches, torch.cat(poses).split(counts), torch.cat(joints).split(counts), strict=True)]


def held(
    part: GraspBatch, rollout: Rollout, sound: Bool[Tensor, " n"]
) -> tuple[Float[Tensor, "n n_dof"], Float[Tensor, "n 4 4"]]:
    """Labels of closed hands, as of `settle_many`: joints and wrist poses; those of the grasp where the closing is unsound."""
    hand = rollout.scene.hand
    reached, T_object_wrist = _reached(part, rollout, hand, sound)
    touching = contact_mask(hand, [
        links for scene, rows in rollout.parts() for links in find_contact_links(scene, rollout.qpos[rows])])
    holding = touching.float() @ hand.tree.moves.float() > 0  # joints that move a contact link
    return torch.where(holding, reached, part.joints), T_object_wrist


def hand_shift(hand: Hand, before: GraspBatch, after: GraspBatch) -> Float[Tensor, " n"]:
    """How far each hand moved relative to the object, at its grasp centre [m]."""
    return (hand.grasp_centres(after.T_object_wrist) - hand.grasp_centres(before.T_object_wrist)).norm(dim=-1)


def after_closing(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol = DEFAULT_PROTOCOL
) -> GraspBatch:
    """The same grasps, outcomes included, in the poses of hand and object after closing, from where a trial goes on.

    A grasp whose simulation is unstable, or that pushes the object farther than LOST_DISTANCE, stays as it is. Errors are those
    of `simulate`.
    """
    scene, parts = scene_of(hand, obj, grasps, protocol), [(grasps.joints[:0], grasps.T_object_wrist[:0])]
    for part, rollout in rollouts(scene, hand, grasps, None):
        closed = rollout.close()
        sound = torch.from_numpy(closed.stable & (closed.shift(rollout.start) < LOST_DISTANCE))
        parts.append(_reached(part, rollout, hand, sound))
    joints, poses = (torch.cat(column) for column in zip(*parts, strict=True))
    return grasps.replace(joints=joints, T_object_wrist=poses)


def _reached(
    part: GraspBatch, rollout: Rollout, hand: Hand, sound: Bool[Tensor, " n"]
) -> tuple[Float[Tensor, "n n_dof"], Float[Tensor, "n 4 4"]]:
    """Joints and wrist poses relative to the object as a rollout has them now; those of the grasp where it is not sound."""
    q, T = (torch.from_numpy(x) for x in rollout.poses())
    q = q.to(part.joints.dtype).clamp(hand.tree.lower, hand.tree.upper)
    T_object_wrist = torch.linalg.inv(torch.where(sound[:, None, None], T, torch.eye(4, dtype=T.dtype))).to(q.dtype)
    return torch.where(sound[:, None], q, part.joints), torch.where(sound[:, None, None], T_object_wrist, part.T_object_wrist)
