"""What constraints cost: grasps returned, candidates dropped, time; and whether what is returned respects them.

    python -m lab.benchmarks.constraints [--hand allegro] [--objects mug spray_bottle hammer] [--num 8] [--cases contact_region]
        [--json]

The last column looks at the vertices of the hand's collision shapes, which no stage of the prediction reads: how far the worst
grasp is from breaking its constraint. Of a wall and of a spared ball that is the distance in grasp and squeeze [mm]; of a
cone, the angle that is left [degrees]; of an opening, the least distance of a closing link to the object in pregrasp, less what
was asked for [mm]; of a place to hold, the number of fingers within 1 cm of its points.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Float

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.anatomy import PALM
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.scenery import load_scene
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from lab.benchmarks.report import emit, options_of

ABOVE = (0.0, 0.0, -1.0)
"""Palm direction from above."""
CONE = 0.5
"""Largest angle from it [rad]."""
GAP = 0.03
"""Distance between the object and a wall beside it [m]."""
OPENING = 0.01
"""Opening that is asked for [m]."""
REACH = 0.01
"""Distance to points of the object's surface, which are some millimetres apart, of a finger that touches it [m]."""

Worst = Callable[[Hand, ObjectModel, GraspBatch], float]
"""How far grasps are from breaking a constraint."""


@dataclass(frozen=True)
class Case:
    """A constraint, and how to look at what it yields."""

    constraints: Constraints
    worst: Worst | None = None


def vertices(
    hand: Hand, T: Float[torch.Tensor, "n 4 4"], q: Float[torch.Tensor, "n n_dof"], closing: bool = False
) -> Float[np.ndarray, "n k 3"]:
    """Vertices of the hand's collision shapes, or of those of its fingers that close [m]."""
    assert hand.description is not None
    poses = (T.float()[:, None] @ hand.tree.forward(q.float())).double().numpy()
    moving = hand.tree.moves[:, hand.movable & ~hand.abduction].any(-1) & (hand.finger_of_link != PALM)
    return np.concatenate([
        shape.vertices @ poses[:, shape.link, :3, :3].transpose(0, 2, 1) + poses[:, shape.link, None, :3, 3]
        for shape in hand.description.geometry
        if shape.collides and shape.link in hand.contact_links and (not closing or bool(moving[shape.link]))], 1)


def cases_of(obj: ObjectModel) -> dict[str, Case]:
    """One case for each constraint, and one of several."""
    low, high = obj.cloud.min(0), obj.cloud.max(0)
    x0 = float(high[0]) + GAP
    wall = trimesh.creation.box((0.02, 1.0, 1.0), trimesh.transformations.translation_matrix((x0 + 0.01, 0, 0)))
    top = (*((low + high) / 2)[:2].tolist(), float(high[2]))
    size = float(high[2] - low[2])
    held, spared = (*top, 0.65 * size), (*top, 0.3 * size)

    def closed(hand: Hand, grasps: GraspBatch) -> Float[np.ndarray, "k 3"]:
        T = grasps.T_object_wrist
        return np.concatenate([vertices(hand, T, q).reshape(-1, 3) for q in (grasps.joints, grasps.squeeze_joints)])

    def to_wall(hand: Hand, _: ObjectModel, grasps: GraspBatch) -> float:
        return 1e3 * (x0 - float(closed(hand, grasps)[:, 0].max()))

    def to_ball(hand: Hand, _: ObjectModel, grasps: GraspBatch) -> float:
        return 1e3 * float((np.linalg.norm(closed(hand, grasps) - spared[:3], axis=1) - spared[3]).min())

    def to_cone(hand: Hand, _: ObjectModel, grasps: GraspBatch) -> float:
        cosine = hand.palm_directions(grasps.T_object_wrist) @ torch.tensor(ABOVE)
        return float(np.rad2deg(CONE - float(torch.acos(cosine.clamp(-1, 1)).max())))

    def opened(hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> float:
        points = vertices(hand, grasps.T_object_wrist, grasps.pregrasp_joints, closing=True).reshape(-1, 3)
        mesh = trimesh.Trimesh(obj.vertices, obj.faces, process=False)
        return 1e3 * (float(trimesh.proximity.closest_point(mesh, points)[1].min()) - OPENING)

    def fingers(hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> float:
        cloud = torch.from_numpy(obj.cloud).float()
        place = cloud[(cloud - torch.tensor(held[:3])).norm(dim=-1) <= held[3]]
        points = hand.points(grasps.joints.float(), grasps.T_object_wrist.float())
        near = torch.cdist(points, place.expand(len(points), -1, -1)).amin(-1) < REACH
        finger = hand.finger_of_link[hand.link_index]
        return float(torch.stack([(near & (finger == i)).any(-1) for i in range(len(hand.fingers))]).sum(0).min())

    scene = load_scene(wall)
    return {
        "nothing": Case(Constraints()), "direction": Case(Constraints(ABOVE)),
        "max_tilt": Case(Constraints(ABOVE, max_tilt=CONE), to_cone), "obstacles": Case(Constraints(obstacles=scene), to_wall),
        "contact_region": Case(Constraints(contact_region=(held,)), fingers),
        "keep_out": Case(Constraints(keep_out=(spared,)), to_ball),
        "pregrasp_clearance": Case(Constraints(pregrasp_clearance=OPENING), opened),
        "max_tilt, obstacles, pregrasp_clearance": Case(
            Constraints(ABOVE, max_tilt=CONE, obstacles=scene, pregrasp_clearance=OPENING), to_wall),
    }


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--hand", default="allegro")
    parser.add_argument("--objects", nargs="+", default=["mug", "spray_bottle", "hammer"])
    parser.add_argument("--num", type=int, default=8, help="grasps that are asked for")
    parser.add_argument("--cases", nargs="+", help="all by default")
    options = parser.parse_args()
    predictor, hand, rows = GraspPredictor(), load_hand(options.hand), []
    objects = [load_object(name) for name in options.objects]
    for name in options.cases or cases_of(objects[0]):
        found, dropped, made, times, worst = 0, 0, 0, [], []
        for obj in objects:
            case = cases_of(obj)[name]
            problem = GraspProblem(hand, obj, constraints=case.constraints)
            _ = problem.field
            begin = time.process_time()
            prediction = predictor.run(problem, GraspRequest(options.num))
            times.append(time.process_time() - begin)
            found, made = found + len(prediction.grasps), made + prediction.candidates
            dropped += sum(prediction.dropped.values())
            if case.worst is not None:
                worst.append(case.worst(hand, obj, prediction.grasps))
        rows.append([name, options.num * len(objects), found, 100 * dropped / made, float(np.median(times)), max(times),
                     min(worst) if worst else None])
        print(*rows[-1], file=sys.stderr, flush=True)
    columns = ["constraint", "asked", "returned", "candidates dropped [%]", "processor time [s], median", "longest", "worst"]
    emit(f"{options.num} grasps under constraints, {options.hand} on {', '.join(options.objects)}", rows, columns,
         {"rows": [dict(zip(columns, row, strict=True)) for row in rows]}, options.json)


if __name__ == "__main__":
    main()
