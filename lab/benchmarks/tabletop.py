"""Grasps of objects that rest on a table, from above and from the side: how many are returned, how soon, and how far above it.

    python -m lab.benchmarks.tabletop [--hands allegro barrett] [--objects mug soap] [--source auto] [--trials carry] [--json]

Every object lies in its most probable stable pose on a table. The clearance is that of the lowest vertex of the hand's
collision shapes, in pregrasp, grasp and squeeze, of all grasps together; no stage of the prediction reads these shapes.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Float

from dro_grasp.errors import NoGraspError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.builtin.usual import OBJECTS
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.loading import mesh_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.config import AUTO, GraspRequest
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.registry import source_names
from dro_grasp.predict.stages import evaluate
from dro_grasp.simulation.protocols import PROTOCOLS
from lab.benchmarks.report import emit, options_of

DIRECTIONS = {"above": (0.0, 0.0, -1.0), "side": (1.0, 0.0, 0.0)}
"""Palm directions."""


@dataclass(frozen=True)
class Row:
    """Grasps of one object from one direction."""

    hand: str
    object: str
    height: float
    """Of the object on the table [m]."""
    side: str
    returned: int
    seconds: float
    """Until they are returned [s]; hand, object and its distance grid are loaded before."""
    cpu: float
    """Processor time of the same [s]."""
    clearance: float | None
    """Height of the lowest vertex of a hand over the table [m]."""
    tilt: float | None
    """Median angle between palm and wanted direction [rad]."""
    held: int | None
    """Grasps that held in their trial."""


def resting(obj: ObjectModel) -> ObjectModel:
    """The object in its most probable stable pose on the plane z = 0."""
    mesh = trimesh.Trimesh(obj.vertices, obj.faces, process=False)
    poses, _ = trimesh.poses.compute_stable_poses(mesh, n_samples=1)
    T = poses[0]
    parts = tuple((np.asarray(trimesh.transform_points(v, T)), f) for v, f in obj.parts)
    placed = trimesh.Trimesh(trimesh.transform_points(mesh.vertices, T), mesh.faces, process=False)
    return mesh_object(obj.name, placed, origin=obj.name, parts=parts)


def lowest_vertex(hand: Hand, grasps: GraspBatch) -> float:
    """Height of the lowest vertex of the hand's collision shapes in all postures of all grasps [m]."""
    assert hand.description is not None
    T = grasps.T_object_wrist.float()[:, None]
    poses = torch.cat([
        T @ hand.tree.forward(q.float()) for q in (grasps.pregrasp_joints, grasps.joints, grasps.squeeze_joints)])
    lowest = [
        _heights(poses[:, shape.link].double().numpy(), shape.vertices).min()
        for shape in hand.description.geometry if shape.collides and shape.link in hand.contact_links]
    return float(min(lowest))


def _heights(poses: Float[np.ndarray, "n 4 4"], vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "n v"]:
    return poses[:, 2, :3] @ vertices.T + poses[:, 2, 3:]


def measure(
    predictor: GraspPredictor, hand: Hand, obj: ObjectModel, side: str, request: GraspRequest, protocol: str | None
) -> Row:
    """Predict, and look at what came back."""
    direction = DIRECTIONS[side]
    problem = GraspProblem(hand, obj, constraints=Constraints(direction, table=0.0))
    _ = problem.field
    begin, cpu = time.perf_counter(), time.process_time()
    try:
        grasps = predictor.run(problem, request).grasps
    except NoGraspError:
        spent = time.perf_counter() - begin, time.process_time() - cpu
        return Row(hand.name, obj.name, problem.height_range[1], side, 0, *spent, None, None, 0 if protocol else None)
    seconds, cpu = time.perf_counter() - begin, time.process_time() - cpu
    palm = hand.palm_directions(grasps.T_object_wrist) @ torch.tensor(direction)
    held = int(evaluate(problem, grasps, protocol).success.sum()) if protocol else None
    return Row(hand.name, obj.name, problem.height_range[1], side, len(grasps), seconds, cpu, lowest_vertex(hand, grasps),
               float(torch.acos(palm.clamp(-1, 1)).median()), held)


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--hands", nargs="+", default=["allegro", "barrett"])
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS), help="the usual built-in ones by default")
    parser.add_argument("--source", choices=(AUTO, *source_names()), default=AUTO)
    parser.add_argument("--num", type=int, default=16, help="grasps that are asked for")
    parser.add_argument("--trials", choices=list(PROTOCOLS), help="also evaluate under a protocol; closing on the table")
    parser.add_argument("--sides", nargs="+", choices=tuple(DIRECTIONS), default=list(DIRECTIONS))
    options = parser.parse_args()
    predictor, request = GraspPredictor(), GraspRequest(options.num, source=options.source)
    rows = []
    for hand in map(load_hand, options.hands):
        for name in resolve_objects(options.objects):
            obj = resting(load_object(name))
            rows += [measure(predictor, hand, obj, side, request, options.trials) for side in options.sides]
    whole, summary = [row.returned == options.num for row in rows], {}
    for hand in options.hands:
        for side in options.sides:
            own = [row for row in rows if (row.hand, row.side) == (hand, side)]
            seconds, cpu = (np.quantile(times, (0.5, 0.95)) for times in ([r.seconds for r in own], [r.cpu for r in own]))
            summary[f"{hand}, {side}"] = (
                f"{sum(r.returned == options.num for r in own)} of {len(own)} objects with all {options.num} grasps; "
                f"median {seconds[0]:.1f} s, 95 % {seconds[1]:.1f} s; processor time {cpu[0]:.1f} s, 95 % {cpu[1]:.1f} s"
                + (f"; held {sum(r.held or 0 for r in own)} of {sum(r.returned for r in own)}" if options.trials else ""))
    lowest = [row.clearance for row in rows if row.clearance is not None]
    keys = {"all_returned": float(np.mean(whole)), "clearance_mm": 1e3 * min(lowest, default=0.0), **summary,
            "rows": [dataclasses.asdict(row) | {"asked": options.num} for row in rows]}
    columns = ["hand", "object", "height [mm]", "from", "returned", "time [s]", "processor [s]", "clearance [mm]", "tilt [deg]",
               "held"]
    cells = [
        [r.hand, r.object, 1e3 * r.height, r.side, r.returned, r.seconds, r.cpu,
         "-" if r.clearance is None else 1e3 * r.clearance, "-" if r.tilt is None else float(np.rad2deg(r.tilt)),
         "-" if r.held is None else r.held] for r in rows]
    emit(f"{options.num} grasps of objects that rest on a table, source {options.source}", cells, columns, keys, options.json)


if __name__ == "__main__":
    main()
