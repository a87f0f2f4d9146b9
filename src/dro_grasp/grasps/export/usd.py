"""Grasps as a USD stage, for Isaac Sim, Omniverse, Blender and others: object, hand, and a variant of the hand for each grasp.

The hand's meshes are there once. Three times hold its postures: 0 the pregrasp, 1 the grasp, 2 the squeeze. Source: OpenUSD's
documentation of UsdGeom and of variant sets; names that begin with `dro_grasp:` are ours.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.extras import require_extra
from dro_grasp.files import free_name
from dro_grasp.geometry.rendering.rasterizer import OBJECT_COLOUR, Colour
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.export.formats import ExportJob
from dro_grasp.grasps.export.writers import Frame, comment, confidence, forces, hold, plain, postures
from dro_grasp.grasps.forces import efforts_of, squeeze_efforts
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel

OWN = "dro_grasp:"  # Begin of the names of attributes of ours
HAND_COLOUR: Colour = (0.58, 0.62, 0.69)  # Grey, as palms have it in pictures
CLOUD_SHARE = 0.008  # Width of a cloud's points over the object's extent (ours)


def usd_file(job: ExportJob) -> bytes:
    """A stage in metres, with z up, in USD's binary form.

    `/World/object` is a mesh, or the points of a cloud. `/World/hand` has a prim for each link, and the variant set `grasp`,
    whose variants pose them. `/World/grasps/grasp_0` and so on are the wrist frames; they state joints, forces and scores.

    Raises:
        OptionError: The extra `[usd]` is not installed, the job lacks hand or object, or the hand came without its description.
    """
    require_extra("usd")
    Usd = _part("Usd")

    if job.hand is None or job.obj is None:
        raise OptionError("a USD stage shows hand and object: give both")
    if job.hand.description is None:
        raise OptionError(f"hand '{job.hand.name}' came without its description, so that it has no meshes; load it by "
                          "dro_grasp.load_hand(FILE)")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "grasps.usd"
        stage = Usd.Stage.CreateNew(str(path))
        _begin(stage, job)
        _add_object(stage, job.obj, job.frame)
        names = _add_links(stage, job.hand)
        _add_grasps(stage, job, names)
        stage.GetRootLayer().Save()
        return path.read_bytes()


def _part(name: str) -> ModuleType:
    """A module of USD, which has no types."""
    return import_module(f"pxr.{name}")


def _begin(stage: Any, job: ExportJob) -> None:
    """Units, times, and what readers have to know."""
    UsdGeom = _part("UsdGeom")

    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(2)
    stage.SetTimeCodesPerSecond(1)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    layer = stage.GetRootLayer()
    layer.comment = comment(job.grasps, job.frame).replace("# ", "").strip()
    layer.customLayerData = {
        "frame": job.frame.name_for(job.grasps), "hand": job.grasps.hand, "wrist_link": job.grasps.wrist_link,
        "object": job.grasps.object[0], "object_file": job.object_path, "object_scale": job.object_scale}


def _add_object(stage: Any, obj: ObjectModel, frame: Frame) -> None:
    UsdGeom = _part("UsdGeom")

    place = UsdGeom.Xform.Define(stage, "/World/object")
    place.AddTransformOp().Set(_matrix(frame.T_frame_object.double().numpy()))
    if obj.vertices is not None and obj.faces is not None:
        _add_mesh(stage, "/World/object/mesh", obj.vertices, obj.faces, OBJECT_COLOUR)
        return
    cloud = UsdGeom.Points.Define(stage, "/World/object/cloud")
    cloud.CreatePointsAttr(_vectors(obj.cloud))
    cloud.CreateWidthsAttr([CLOUD_SHARE * float(np.linalg.norm(obj.extents))])
    cloud.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    cloud.CreateExtentAttr(_vectors(np.stack([obj.cloud.min(0), obj.cloud.max(0)])))
    _colour(cloud, OBJECT_COLOUR)


def _add_links(stage: Any, hand: Hand) -> list[str]:
    """Paths of prims for all links, each with its visual shapes."""
    Tf, UsdGeom = _part("Tf"), _part("UsdGeom")

    UsdGeom.Xform.Define(stage, "/World/hand")
    taken = dict[str, str]()
    for name in hand.tree.link_names:
        taken[free_name(Tf.MakeValidIdentifier(name), taken, numbered="_{}")] = name
    paths = [f"/World/hand/{valid}" for valid in taken]
    for path, name in zip(paths, taken.values(), strict=True):
        link = UsdGeom.Xform.Define(stage, path)
        link.AddTransformOp()
        link.GetPrim().SetDisplayName(name)
    assert hand.description is not None
    for i, shape in enumerate(hand.description.geometry):
        if shape.visual:
            _add_mesh(stage, f"{paths[shape.link]}/shape_{i}", shape.vertices, shape.faces, HAND_COLOUR)
    return paths


def _add_grasps(stage: Any, job: ExportJob, links: list[str]) -> None:
    """A wrist frame and a variant of the hand for each grasp; the first is chosen."""
    UsdGeom = _part("UsdGeom")

    grasps, hand = job.grasps, job.hand
    assert hand is not None
    T = job.frame.T_frame_object.double() @ grasps.T_object_wrist.double()
    told, efforts = postures(grasps), squeeze_efforts(grasps, hand)
    poses = [(T[:, None] @ hand.tree.forward(joints).double()).numpy() for joints in told.values()]
    variants = stage.GetPrimAtPath("/World/hand").GetVariantSets().AddVariantSet("grasp")
    UsdGeom.Scope.Define(stage, "/World/grasps")
    for i in range(len(grasps)):
        name = f"grasp_{i}"
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            for link, path in enumerate(links):
                operation, = UsdGeom.Xformable(stage.GetPrimAtPath(path)).GetOrderedXformOps()
                for time, of_posture in enumerate(poses):
                    operation.Set(_matrix(of_posture[i, link]), time)
        wrist = UsdGeom.Xform.Define(stage, f"/World/grasps/{name}")
        wrist.AddTransformOp().Set(_matrix(T[i].numpy()))
        _state(wrist.GetPrim(), grasps, i, {posture: joints[i] for posture, joints in told.items()}, efforts_of(efforts, i))
    if len(grasps):
        variants.SetVariantSelection("grasp_0")


def _state(
    prim: Any, grasps: GraspBatch, i: int, joints: dict[str, Float[Tensor, " n_dof"]], effort: Float[Tensor, " n_dof"] | None
) -> None:
    """What is known of a grasp, as attributes; what is unknown is left out."""
    Sdf = _part("Sdf")

    def add(name: str, kind: Any, value: object) -> None:
        prim.CreateAttribute(OWN + name, kind, True).Set(value)

    kinds = Sdf.ValueTypeNames
    add("joint_names", kinds.StringArray, list(grasps.joint_names))
    for posture, values in joints.items():
        add(f"{posture}_joints", kinds.DoubleArray, plain(values))
    if effort is not None:
        add("squeeze_effort", kinds.DoubleArray, plain(effort))
    for name, row in hold(grasps, i).items():
        add(name, kinds.DoubleArray, plain(row))
    numbers: dict[str, float | None] = {"confidence": confidence(grasps, i), **forces(grasps, i)}
    for name, value in numbers.items():
        if value is not None:
            add(name, kinds.Double, value)
    if bool(grasps.evaluated[i]):
        add("success", kinds.Bool, bool(grasps.success[i]))
        add("protocol", kinds.String, grasps.protocol[i])


def _add_mesh(
    stage: Any, path: str, vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], colour: Colour
) -> None:
    UsdGeom, Vt = _part("UsdGeom"), _part("Vt")

    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(_vectors(vertices))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces, np.int32).ravel()))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)  # as it is, not smoothed
    mesh.CreateExtentAttr(_vectors(np.stack([np.min(vertices, 0), np.max(vertices, 0)])))
    _colour(mesh, colour)


def _colour(shape: Any, colour: Colour) -> None:
    Gf = _part("Gf")

    shape.CreateDisplayColorAttr([Gf.Vec3f(*colour)])


def _vectors(points: Float[np.ndarray, "n 3"]) -> Any:
    Vt = _part("Vt")

    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points, np.float32))


def _matrix(T: Float[np.ndarray, "4 4"]) -> Any:
    """A pose as USD has it, whose vectors are rows."""
    Gf = _part("Gf")

    return Gf.Matrix4d(T.T.tolist())
