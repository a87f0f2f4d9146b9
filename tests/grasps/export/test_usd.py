"""USD stages, opened again by USD's own library: every link, point and number is where it should be."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dro_grasp import extras
from dro_grasp.cli.main import main
from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import HOLD_COLUMNS
from dro_grasp.grasps.controller import complete
from dro_grasp.grasps.export.formats import ExportJob
from dro_grasp.grasps.export.usd import usd_file
from dro_grasp.grasps.export.writers import Frame
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from tests.helpers.loaded_hands import loaded_hand

Usd, UsdGeom, UsdValidation = (pytest.importorskip(f"pxr.{name}") for name in ("Usd", "UsdGeom", "UsdValidation"))

HAND, COUNT = "gripper3", 3
T_FRAME = np.eye(4)
T_FRAME[:3, :3], T_FRAME[:3, 3] = Rotation.from_euler("xyz", [0.3, -0.8, 1.2]).as_matrix(), [0.4, -0.1, 0.9]


@pytest.fixture(scope="module")
def hand() -> Hand:
    return loaded_hand(HAND)


@pytest.fixture(scope="module")
def obj() -> ObjectModel:
    return load_object("mug")


@pytest.fixture(scope="module")
def grasps(hand: Hand, obj: ObjectModel) -> GraspBatch:
    generator = torch.Generator().manual_seed(0)
    T = torch.eye(4).repeat(COUNT, 1, 1)
    T[:, :3, :3] = torch.from_numpy(Rotation.from_rotvec(np.random.default_rng(1).normal(size=(COUNT, 3))).as_matrix())
    T[:, :3, 3] = 0.1 * torch.randn(COUNT, 3, generator=generator)
    effort = torch.full((COUNT, len(hand.tree.joint_names)), 0.25)
    effort[2] = torch.nan
    made = GraspBatch.create(
        hand, obj, T, hand.random_joints(COUNT, generator), score=torch.tensor([2.0, 0.0, torch.nan]),
        payload=torch.tensor([0.5, torch.nan, torch.nan]), squeeze_torque=effort,
        success=torch.tensor([True, False, False]), protocol=("carry", "carry", ""),
        extra={name: torch.full((COUNT, len(hand.tree.joint_names)), 0.1 * k) for k, name in enumerate(HOLD_COLUMNS)})
    return complete(hand, made, torch.zeros(3))


def opened(content: bytes, folder: Path) -> Any:
    (folder / "grasps.usd").write_bytes(content)
    return Usd.Stage.Open(str(folder / "grasps.usd"))


def place(stage: Any, path: str, time: float = 0.0) -> np.ndarray:
    return np.array(UsdGeom.Xformable(stage.GetPrimAtPath(path)).ComputeLocalToWorldTransform(time)).T


@pytest.fixture(scope="module")
def stage(hand: Hand, obj: ObjectModel, grasps: GraspBatch, tmp_path_factory: pytest.TempPathFactory) -> Any:
    frame = Frame("base", torch.from_numpy(T_FRAME).float())
    return opened(usd_file(ExportJob(grasps, frame, hand, "mug.stl", 1.0, obj)), tmp_path_factory.mktemp("usd"))


def test_every_variant_poses_every_link_at_every_posture(stage: Any, hand: Hand, grasps: GraspBatch) -> None:
    variants = stage.GetPrimAtPath("/World/hand").GetVariantSet("grasp")
    assert variants.GetVariantNames() == [f"grasp_{i}" for i in range(COUNT)]
    assert variants.GetVariantSelection() == "grasp_0"
    for i in range(COUNT):
        variants.SetVariantSelection(f"grasp_{i}")
        for time, joints in enumerate((grasps.pregrasp_joints, grasps.joints, grasps.squeeze_joints)):
            poses = hand.tree.forward(joints[i]).double().numpy()
            for link, name in enumerate(hand.tree.link_names):
                expected = T_FRAME @ grasps.T_object_wrist[i].double().numpy() @ poses[link]
                np.testing.assert_allclose(place(stage, f"/World/hand/{name}", time), expected, atol=1e-6)
        np.testing.assert_allclose(
            place(stage, f"/World/grasps/grasp_{i}"), T_FRAME @ grasps.T_object_wrist[i].double().numpy(), atol=1e-6)


def test_meshes_are_those_of_hand_and_object(stage: Any, hand: Hand, obj: ObjectModel) -> None:
    assert hand.description is not None
    found = {str(prim.GetPath()): UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)}
    shapes = [g for g in hand.description.geometry if g.visual]
    assert len(found) == 1 + len(shapes)
    own = found["/World/object/mesh"]
    assert obj.vertices is not None
    assert obj.faces is not None
    np.testing.assert_allclose(np.array(own.GetPointsAttr().Get()), obj.vertices, atol=1e-7)
    np.testing.assert_array_equal(np.array(own.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), obj.faces)
    np.testing.assert_allclose(place(stage, "/World/object"), T_FRAME, atol=1e-6)
    held = sorted(len(mesh.GetPointsAttr().Get()) for path, mesh in found.items() if path.startswith("/World/hand"))
    assert held == sorted(len(shape.vertices) for shape in shapes)


def test_numbers_are_stated_where_they_are_known(stage: Any, grasps: GraspBatch) -> None:
    def stated(i: int) -> dict[str, Any]:
        prim = stage.GetPrimAtPath(f"/World/grasps/grasp_{i}")
        return {a.GetName().removeprefix("dro_grasp:"): a.Get() for a in prim.GetAttributes()
                if a.GetName().startswith("dro_grasp:")}

    first, second, third = stated(0), stated(1), stated(2)
    assert list(first["joint_names"]) == list(grasps.joint_names)
    for name in ("pregrasp_joints", "squeeze_joints"):
        np.testing.assert_allclose(first[name], getattr(grasps, name)[0], atol=1e-6)
    np.testing.assert_allclose(first["grasp_joints"], grasps.joints[0], atol=1e-6)
    for k, name in enumerate(HOLD_COLUMNS[:4]):
        np.testing.assert_allclose(first[name], 0.1 * k, atol=1e-6)
    assert first["confidence"] == pytest.approx(1 / (1 + np.exp(-2.0)), abs=1e-6)
    assert (first["success"], second["success"], first["protocol"]) == (True, False, "carry")
    assert (first["payload"], set(first) - set(second)) == (0.5, {"payload"})
    assert set(second) - set(third) == {"confidence", "success", "protocol", "squeeze_effort"}


def test_a_stage_states_its_units_and_passes_the_validators_of_usd(stage: Any) -> None:
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (1.0, "Z")
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert stage.GetRootLayer().customLayerData["wrist_link"] == loaded_hand(HAND).wrist_link
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    faults = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [fault.GetErrorAsString() for fault in faults] == []


def test_a_cloud_is_points(hand: Hand, obj: ObjectModel, grasps: GraspBatch, tmp_path: Path) -> None:
    cloud = replace(obj, vertices=None, faces=None)
    stage = opened(usd_file(ExportJob(grasps, Frame(), hand, "mug.ply", 1.0, cloud)), tmp_path)
    points = stage.GetPrimAtPath("/World/object/cloud").GetAttribute("points").Get()
    np.testing.assert_allclose(np.array(points), obj.cloud, atol=1e-7)


def test_the_command_writes_a_stage(grasps: GraspBatch, tmp_path: Path) -> None:
    grasps.save(tmp_path / "mug.parquet")
    assert main(["export", str(tmp_path / "mug.parquet"), "--format", "usd", "--output", str(tmp_path / "mug.usd")]) == 0
    stage = Usd.Stage.Open(str(tmp_path / "mug.usd"))
    assert len(stage.GetPrimAtPath("/World/grasps").GetChildren()) == COUNT


def test_what_a_stage_needs_is_asked_for(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(OptionError, match="give both"):
        usd_file(ExportJob(grasps, Frame(), hand))
    with pytest.raises(OptionError, match="came without its description"):
        usd_file(ExportJob(grasps, Frame(), replace(hand, description=None), obj=obj))
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name == "pxr" else object())
    with pytest.raises(OptionError, match=r"pxr.*dro-grasp\[usd\]"):
        usd_file(ExportJob(grasps, Frame(), hand, obj=obj))
