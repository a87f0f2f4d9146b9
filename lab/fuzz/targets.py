"""What is fuzzed: for each kind of file sound ones, how they are damaged, and the readers that meet them."""

from __future__ import annotations

import io
import json
import pickle
import random
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
import trimesh
import yaml
from safetensors.torch import load, save

from dro_grasp.apps.library import store_upload
from dro_grasp.arm.robots.loading import load_robot
from dro_grasp.errors import DroGraspError
from dro_grasp.files import check_folder, check_output
from dro_grasp.frames import read_motion
from dro_grasp.geometry.cache import cached_arrays
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.grasp_file import METADATA_KEY
from dro_grasp.grasps.sources import frame_of, hand_of, object_of, with_sources
from dro_grasp.hands.library import load_hand
from dro_grasp.network.checkpoints import describe_weights, history_of, load_weights, save_weights, verify_weights
from dro_grasp.network.network import DistanceNetwork, untrained_network
from dro_grasp.network.presets import NetworkConfig
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.perception.scan import depth_points, load_scan, scanned_object
from dro_grasp.objects.scenery import load_scene
from dro_grasp.training.data.bundle.training_file import ObjectCloud, load_bundle, write_bundle
from dro_grasp.training.data.collections.collection import count_collection, read_collection
from dro_grasp.training.data.collections.importing import read_foreign
from dro_grasp.training.runs import CHECKPOINT, LOG, RunFolder
from lab.fuzz import mutations as damage

Rng = random.Random
TINY = NetworkConfig(
    n_hand=48, n_object=32, width=16, encoder_widths=(8, 16), neighbours=6, attention_hidden=16, latent=4,
    latent_widths=(8, 16), latent_head=(16, 16), latent_neighbours=6, kernel_hidden=(16, 8), frame="palm", placement_width=16,
)
"""A network whose weights are small (ours)."""
LIMIT = '<limit lower="0" upper="1.5" effort="1" velocity="1"/>'
URDF = f"""<robot name="claw">
  <link name="palm"><inertial><mass value="0.1"/><origin xyz="0 0 0" rpy="0 0 0"/>
    <inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-4"/></inertial>
    <collision><geometry><box size="0.08 0.08 0.02"/></geometry></collision></link>
  <link name="left"><visual><origin xyz="0 0 0.03"/><geometry><mesh filename="left.obj" scale="1 1 1"/></geometry></visual>
    <collision><origin xyz="0 0 0.03"/><geometry><box size="0.012 0.012 0.06"/></geometry></collision></link>
  <link name="right"><collision><origin xyz="0 0 0.03" rpy="0 0 0"/><geometry><cylinder radius="0.006" length="0.06"/>
    </geometry></collision></link>
  <link name="tip"><collision><origin xyz="0 0 0.01"/><geometry><sphere radius="0.008"/></geometry></collision></link>
  <joint name="a" type="revolute"><parent link="palm"/><child link="left"/>
    <origin xyz="-0.035 0 0.01"/><axis xyz="0 1 0"/>{LIMIT}</joint>
  <joint name="b" type="revolute"><parent link="palm"/><child link="right"/>
    <origin xyz="0.035 0 0.01"/><axis xyz="0 -1 0"/>{LIMIT}</joint>
  <joint name="c" type="revolute"><parent link="left"/><child link="tip"/><origin xyz="0 0 0.06"/><axis xyz="0 1 0"/>{LIMIT}
    <mimic joint="a" multiplier="0.5" offset="0.1"/></joint>
</robot>"""
"""A hand of two fingers (ours)."""
MJCF = """<mujoco model="claw"><compiler angle="degree" autolimits="true"/><option timestep="0.002"/>
  <default><joint damping="0.1"/><default class="finger"><geom type="capsule" size="0.007" mass="0.02"/></default></default>
  <asset><mesh name="m" file="left.obj" scale="1 1 1"/></asset>
  <worldbody><body name="palm" pos="0 0 0.1" quat="1 0 0 0"><geom type="box" size="0.05 0.05 0.01" mass="0.2"/>
    <body name="left" pos="-0.04 0 0.01"><joint name="a" axis="0 1 0" range="0 80" ref="0"/>
      <geom class="finger" fromto="0 0 0 0 0 0.05"/><geom type="mesh" mesh="m" contype="0" conaffinity="0"/>
      <body name="tip" pos="0 0 0.05"><joint name="c" axis="0 1 0" range="0 60"/>
        <geom class="finger" fromto="0 0 0 0 0 0.02"/></body></body>
    <body name="right" pos="0.04 0 0.01" euler="0 0 10"><joint name="b" axis="0 -1 0" range="0 80"/>
      <geom class="finger" fromto="0 0 0 0 0 0.05"/></body></body></worldbody>
  <tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed></tendon>
  <actuator><position tendon="t" kp="1" ctrlrange="0 1"/></actuator>
  <equality><joint joint1="c" joint2="a" polycoef="0 0.5 0 0 0"/></equality>
  <keyframe><key name="open" qpos="0 0 0"/></keyframe></mujoco>"""
"""The same as MJCF, with a tendon, an equality and a keyframe (ours)."""
SRDF = '<robot><group_state name="open"><joint name="a" value="0.1"/><joint name="b" value="0"/></group_state></robot>'
"""The open posture of the hand (ours)."""
CONNECTED = """<mujoco model="linked"><compiler angle="radian"/><worldbody><geom type="box" size=".05 .04 .01"/>
  <body name="left" pos="-.04 0 .01"><joint name="a" axis="0 1 0" range="0 1.4"/><geom type="capsule" size=".006"
    fromto="0 0 0 0 0 .06"/><site name="eye" pos="0 .01 .03"/></body>
  <body name="rod" pos="-.06 .01 .01"><joint name="socket" type="ball"/><geom type="capsule" size=".003"
    fromto="0 0 0 .02 0 .03"/><site name="end" pos=".02 0 .03"/></body>
  <body name="right" pos=".04 0 .01"><joint name="b" axis="0 -1 0" range="0 1.4"/><geom type="capsule" size=".006"
    fromto="0 0 0 0 0 .06"/><site name="nail" pos="0 0 .05"/></body></worldbody>
  <equality><connect site1="eye" site2="end"/></equality>
  <tendon><spatial name="cord"><site site="eye"/><site site="nail"/></spatial></tendon>
  <actuator><position joint="b" kp="1"/><position tendon="cord" kp="1"/></actuator></mujoco>"""
"""Fingers on the world, a rod in a ball joint that closes a loop, and a cord over sites (ours)."""
ARM = f"""<robot name="arm"><link name="base"/><link name="upper"/><link name="flange"/>
  <joint name="q1" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>{LIMIT}</joint>
  <joint name="q2" type="revolute"><parent link="upper"/><child link="flange"/><origin xyz="0 0 0.3"/><axis xyz="0 1 0"/>{LIMIT}
  </joint></robot>"""
"""An arm of two joints (ours)."""
ROBOT: dict[str, Any] = {
    "name": "r", "arm": "arm.urdf", "hand": "hand.urdf",
    "mount": {"link": "flange", "position": [0.0, 0.0, 0.02], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]},
    "base": {"position": [0.0, 0.0, 0.1]}, "home": {"q1": 0.5, "q2": 0.5},
    "limits": {"velocity": 1.0, "acceleration": {"q1": 2.0, "q2": 2.0}, "effort": 30, "position": {"q1": [0.0, 1.0]}},
    "hand_limits": {"velocity": 2.0, "acceleration": 10.0}, "table": {"height": 0.0, "centre": [0.4, 0.0], "size": [1.0, 1.0]},
    "camera": {"position": [1.0, 0.0, 0.8], "target": [0.4, 0.0, 0.0], "width": 64, "height": 48, "focal": 60.0}}
"""A robot with every entry (ours)."""
MESHES = ("stl", "obj", "ply", "off", "glb", "gltf", "3mf", "dae")
"""Mesh formats (ours: those that the documents name)."""
CLOUDS = ("cloud.npy", "cloud.ply", "normals.ply", "ascii.pcd", "binary.pcd", "packed.pcd")
"""Files of clouds."""
PATHS = (
    "", "a" * 10_000, "/" + "a/" * 3000, "~nobody", "~nobody/x.urdf", "~/x.obj", "\0", "x\0.stl", ".", "..", "/", "/dev/null",
    "/dev/zero", "/dev/full", "/proc/self/mem", "assets/", "assets/../..", "nan", "x.urdf", "x.stl", "x.parquet", "\udcff",
    "\udcff.obj", "é.npy", "*", "a/b/c.xml", "os", "robot_descriptions", "-h", "builtin:", "assets:train", "fifo",
    "a" * 300 + ".obj", "a" * 300 + ".urdf",
)
"""Names and paths that are none (ours)."""


@dataclass(frozen=True)
class Target:
    """One kind of file."""

    write: Callable[[Rng, Path, Path], Path]
    """Writes a damaged file into the second folder, after sound ones in the first."""
    read: Callable[[Path], object]
    """Reads it as the product does."""
    share: int
    """Cases of this kind among all, in relation to the others."""


def make_seeds(folder: Path) -> None:
    """Write the sound files."""
    mesh = trimesh.creation.box((0.03, 0.04, 0.05))
    mesh.export(folder / "left.obj")
    for kind in MESHES[:-1]:
        radius = 30 if kind == "3mf" else 0.03  # millimetres by default
        trimesh.creation.icosphere(subdivisions=1, radius=radius).export(folder / f"mesh.{kind}")
    points = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    points.apply_translation((0, 0, 0.4))  # in front of a camera
    table = np.concatenate([points.vertices, points.vertex_normals], 1)
    np.save(folder / "cloud.npy", table)
    trimesh.PointCloud(points.vertices).export(folder / "cloud.ply")
    head = ("VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 162\nHEIGHT 1\nPOINTS 162\nDATA ")
    (folder / "ascii.pcd").write_text(head + "ascii\n" + "\n".join(" ".join(f"{x:.5f}" for x in p) for p in points.vertices))
    (folder / "binary.pcd").write_bytes(head.encode() + b"binary\n" + points.vertices.astype("<f4").tobytes())
    _make_clouds(folder, points, head)
    (folder / "arm.urdf").write_text(ARM)
    (folder / "hand.urdf").write_text(URDF)
    hand, obj = load_hand(folder / "hand.urdf"), load_object(folder / "mesh.stl")
    T = torch.eye(4).repeat(3, 1, 1)
    held, joints = torch.tensor([True, False, True]), hand.canonical_joints().expand(3, -1).clone()
    grasps = GraspBatch.create(hand, obj, T, joints, success=held)
    grasps = with_sources(grasps, str(folder / "hand.urdf"), str(folder / "cloud.npy"), 1.0)
    camera = {"frame": ("base",) * 3, "T_frame_camera": torch.eye(4).reshape(1, 16).repeat(3, 1)}
    grasps = grasps.replace(extra=grasps.extra | camera)
    grasps.save(folder / "grasps.parquet", {"yields": {obj.name: {"candidates": 5, "failures": {"x": 2}}}})
    network = untrained_network(TINY, 0)
    save_weights(network, folder / "weights.safetensors", {"data": {"hands": {"claw": 1}, "grasps": 1, "objects": 1}})
    cloud = ObjectCloud(torch.from_numpy(obj.cloud[:64]), torch.from_numpy(obj.cloud_normals[:64]))
    write_bundle(folder / "bundle.safetensors", [hand], {obj.name: cloud}, [grasps.replace(split=("train",) * 3)])
    optimiser = torch.optim.Adam(network.parameters())
    RunFolder(folder).write_checkpoint({
        "step": 1, "seconds": 1.0, "model": network.state_dict(), "average": network.state_dict(),
        "optimiser": optimiser.state_dict(), "plan": {"steps": 5}})
    (folder / LOG).write_text('{"step": 1, "total": 1.0}\n{"step": 2, "total": 0.5}\n')
    torch.save({"metadata": [(torch.zeros(8), "contactdb+apple", "barrett")]}, folder / "cmap.pt")
    qpos = dict.fromkeys(("WRJTx", "WRJTy", "WRJTz", "WRJRx", "WRJRy", "WRJRz", "a"), 0.1)
    np.save(folder / "dexgraspnet.npy", np.array([{"qpos": qpos, "scale": 0.1}], dtype=object), allow_pickle=True)
    bench = {"grasp_qpos": np.eye(9)[:2] + 0.1, "joint_names": ["a", "b"], "obj_scale": 0.1, "obj_path": "x/y"}
    np.save(folder / "dexgraspbench.npy", np.array(bench, dtype=object), allow_pickle=True)
    (folder / "frame.json").write_text(json.dumps({"frame": "base", "T_frame_camera": np.eye(4).tolist()}))
    np.savez(folder / "cache.npz", values=np.zeros((3, 3)), origin=np.zeros(3))
    with zipfile.ZipFile(folder / "hand.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(folder / "hand.urdf", "hand/hand.urdf")
        archive.write(folder / "left.obj", "hand/left.obj")


def _make_clouds(folder: Path, points: trimesh.Trimesh, head: str) -> None:
    """Clouds as PCL packs them and with the normals of a PLY, and a camera's depth image of a ball."""
    import lzf  # type: ignore  # compiled, without types

    columns = points.vertices.T.astype("<f4").tobytes()
    packed = lzf.compress(columns, 2 * len(columns)) or columns
    sizes = len(packed).to_bytes(4, "little") + len(columns).to_bytes(4, "little")
    (folder / "packed.pcd").write_bytes(head.encode() + b"binary_compressed\n" + sizes + packed)
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    rows = np.concatenate([points.vertices, points.vertex_normals], 1)
    (folder / "normals.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n{names}end_header\n" + "\n".join(
        " ".join(f"{x:.5f}" for x in row) for row in rows))
    row, column = np.mgrid[:48, :64] - np.array([24, 32])[:, None, None]
    inside = row**2 + column**2 < 15**2
    np.savez(folder / "depth.npz", image=np.where(inside, 0.5 - 1e-4 * (15**2 - row**2 - column**2), 0.0),
             intrinsics=np.array([[200.0, 0, 32], [0, 200, 24], [0, 0, 1]]), mask=inside)


def _description(name: str, text: str) -> Callable[[Rng, Path, Path], Path]:
    def write(rng: Rng, seeds: Path, folder: Path) -> Path:
        path, obj = folder / name, (seeds / "left.obj").read_bytes()
        kind = rng.randrange(10)
        changed = damage.damage_text(rng, text) if kind == 1 else text if kind in (0, 9) else damage.damage_xml(rng, text)
        content = changed.encode(errors="replace")
        path.write_bytes(damage.damage_bytes(rng, content) if kind == 0 else content)
        (folder / "left.obj").write_bytes(damage.damage_text(rng, obj.decode()).encode() if kind == 9 else obj)
        if rng.random() < 0.1:
            (folder / "hand.srdf").write_bytes(damage.damage_xml(rng, SRDF).encode(errors="replace"))
        return path
    return write


def _plain(*names: str, text: bool = False) -> Callable[[Rng, Path, Path], Path]:
    """Files that are damaged byte by byte, and token by token where they are text."""
    def write(rng: Rng, seeds: Path, folder: Path) -> Path:
        name = rng.choice(names)
        data, path = (seeds / name).read_bytes(), folder / name
        if text and rng.random() < 0.6:
            data = damage.damage_text(rng, data.decode("latin1")).encode("utf8", "replace")
        else:
            data = damage.damage_bytes(rng, data)
        path.write_bytes(data)
        return path
    return write


def _mesh(rng: Rng, seeds: Path, folder: Path) -> Path:
    """A damaged mesh of any format, or an odd one."""
    if rng.random() < 0.6:
        return _plain(*(f"mesh.{kind}" for kind in MESHES[:-1]), text=True)(rng, seeds, folder)
    path = folder / f"odd.{rng.choice(('obj', 'off'))}"
    vertices, faces = damage.odd_mesh(rng)
    if path.suffix == ".obj":
        lines = [f"v {x} {y} {z}" for x, y, z in vertices.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    else:
        lines = ["OFF", f"{len(vertices)} {len(faces)} 0"] + [f"{x} {y} {z}" for x, y, z in vertices.tolist()]
        lines += [f"3 {a} {b} {c}" for a, b, c in faces.tolist()]
    path.write_text("\n".join(lines) + "\n")
    return path


def _cloud(rng: Rng, seeds: Path, folder: Path) -> Path:
    """A damaged cloud of any format, or an odd one."""
    kind = rng.randrange(4)
    if kind == 0:
        path = folder / "odd.npy"
        path.write_bytes(damage.damage_npy(rng, np.load(seeds / "cloud.npy")))
        return path
    if kind == 1:
        path = folder / "odd.npy"
        points = damage.odd_mesh(rng)[0]
        normals = points * rng.choice((0.0, 1.0, 1e300, float("nan")))
        np.save(path, np.concatenate([points, normals], 1) if rng.random() < 0.5 else points)
        return path
    return _plain(*CLOUDS, text=kind == 2)(rng, seeds, folder)


def _depth(rng: Rng, seeds: Path, folder: Path) -> Path:
    """A depth image, its intrinsics and its mask, of which one or two are of other values, types or shapes."""
    with np.load(seeds / "depth.npz") as stored:
        tensors = {name: torch.from_numpy(stored[name]) for name in stored.files}
    damaged = damage.damage_tensors(rng, tensors)
    if rng.random() < 0.3:
        name = rng.choice(list(damaged))
        damaged[name] = damaged[name] * rng.choice((1e-3, 2, 1e3, 1e4, -1, 1e30))
    path = folder / "depth.npz"
    np.savez(path, **{name: tensor.numpy() for name, tensor in damaged.items()})  # type: ignore[arg-type]
    return path


def _robot(rng: Rng, seeds: Path, folder: Path) -> Path:
    """A damaged robot file, or one whose arm is damaged."""
    path, kind = folder / "robot.yaml", rng.randrange(6)
    arm = damage.damage_xml(rng, ARM) if kind == 0 else ARM
    (folder / "arm.urdf").write_bytes(arm.encode(errors="replace"))
    for name in ("hand.urdf", "left.obj"):
        (folder / name).write_bytes((seeds / name).read_bytes())
    text = yaml.safe_dump(damage.damage_json(rng, ROBOT) if kind > 2 else ROBOT)
    text = damage.damage_text(rng, text) if kind in (1, 2) else text
    path.write_bytes(damage.damage_bytes(rng, text.encode()) if kind == 1 else text.encode(errors="replace"))
    return path


def _grasps(rng: Rng, seeds: Path, folder: Path) -> Path:
    path, table = folder / "grasps.parquet", pq.read_table(seeds / "grasps.parquet", use_threads=False)
    kind = rng.randrange(8)
    if kind == 0:
        path.write_bytes(damage.damage_bytes(rng, (seeds / "grasps.parquet").read_bytes()))
        return path
    header = json.loads(table.schema.metadata[METADATA_KEY])
    columns = {name: table[name].combine_chunks() for name in table.column_names}
    if kind < 5:
        header = damage.damage_json(rng, header)
    if kind > 3:
        columns = damage.damage_columns(rng, columns)
    pq.write_table(pa.table(columns).replace_schema_metadata({METADATA_KEY: json.dumps(header).encode()}), path)
    return path


def _tensors(name: str, key: str) -> Callable[[Rng, Path, Path], Path]:
    def write(rng: Rng, seeds: Path, folder: Path) -> Path:
        path, data = folder / name, (seeds / name).read_bytes()
        kind = rng.randrange(5)
        if kind == 0:
            path.write_bytes(damage.damage_bytes(rng, data))
            return path
        tensors, length = load(data), int.from_bytes(data[:8], "little")
        entry = json.loads(json.loads(data[8 : 8 + length])["__metadata__"][key])
        if kind < 4:
            entry = damage.damage_json(rng, entry)
        if kind > 2:
            tensors = damage.damage_tensors(rng, tensors)
        path.write_bytes(save(tensors, {key: json.dumps(entry)}))
        return path
    return write


def _json(rng: Rng, seeds: Path, folder: Path) -> Path:
    if rng.random() < 0.3:
        return _plain("frame.json", text=True)(rng, seeds, folder)
    path = folder / "frame.json"
    path.write_text(json.dumps(damage.damage_json(rng, json.loads((seeds / path.name).read_text()))))
    return path


def _foreign(rng: Rng, seeds: Path, folder: Path) -> Path:
    """A damaged file of another project; the content of pickles is replaced too."""
    name = rng.choice(("cmap.pt", "dexgraspnet.npy", "dexgraspbench.npy"))
    if rng.random() < 0.6:
        return _plain(name)(rng, seeds, folder)
    path = folder / name
    if name == "cmap.pt":
        rows = [[[0.0] * 8, "apple", "barrett"]]
        torch.save(damage.damage_json(rng, {"metadata": rows}), path)
        return path
    qpos = dict.fromkeys(("WRJTx", "WRJTy", "WRJTz", "WRJRx", "WRJRy", "WRJRz", "a"), 0.1)
    entry: Any = [{"qpos": qpos, "scale": 0.1}] if "net" in name else {
        "grasp_qpos": [[0.1] * 9], "joint_names": ["a", "b"], "obj_pose": [[0, 0, 0, 1, 0, 0, 0]], "obj_scale": 0.1}
    entry = damage.damage_json(rng, entry)
    shaped = np.empty((), object)
    shaped[()] = entry
    with io.BytesIO() as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
        path.write_bytes(file.getvalue() + pickle.dumps(shaped, 4))
    return path


def _path(rng: Rng, seeds: Path, folder: Path) -> Path:
    name = rng.choice(PATHS)
    if rng.random() < 0.3:
        name += rng.choice((".obj", ".urdf", ".npy", ".parquet", ".safetensors", "/x", "\n"))
    return Path(name)


def _read_grasps(path: Path) -> None:
    """Load the grasps, and go through what `dataset`, `evaluate` and `picture` read of them."""
    count_collection(path)
    for pair in read_collection(path, only_successful=False):
        grasps = pair.grasps
        if not len(grasps):
            continue
        _ = repr(grasps), grasps.to_bytes(), frame_of(grasps), pair.made.per_cpu_hour
        grasps.require_hand(hand_of(grasps, None))
        object_of(grasps, None, 1.0)


def _read_weights(path: Path) -> None:
    verify_weights(path)
    describe_weights(path)
    history_of(path)
    network: DistanceNetwork = load_weights(path)
    cloud = torch.rand(1, 64, 3, generator=torch.Generator().manual_seed(0))
    noise = network.sample_latent(1, torch.Generator().manual_seed(0))
    if not network.predict(cloud, cloud, noise).isfinite().all():
        raise ArithmeticError("distances that are not finite")


def _read_run(path: Path) -> None:
    folder = RunFolder(path.parent)
    folder.read_checkpoint({"steps": 5})
    folder.cut_log(1)


def _read_foreign(path: Path) -> None:
    read_foreign(path, path.stem)  # type: ignore[arg-type]


def _read_cloud(path: Path) -> None:
    """All readers that a cloud has: as an object, of a camera, and as what stands around."""
    faults = []
    for read in (load_object, lambda p: load_scan(p, np.eye(4)), load_scene):
        try:
            read(path)
        except DroGraspError as error:
            faults.append(error)
    if faults:
        raise faults[0]


def _read_depth(path: Path) -> None:
    with np.load(path) as stored:
        given = {name: stored[name] for name in stored.files}
    points = depth_points(given.get("image"), given.get("intrinsics"), given.get("mask"))  # type: ignore[arg-type]
    scanned_object("ball", points, np.eye(4))


def _read_upload(path: Path) -> None:
    (path.parent / "unpacked").mkdir()
    load_hand(store_upload(path.name, path.read_bytes(), path.parent / "unpacked"))


def _read_path(path: Path) -> None:
    readers: list[Callable[[Any], object]] = [
        load_hand, load_object, GraspBatch.load, count_collection, load_weights, load_bundle, check_output, check_folder,
        lambda p: read_motion(p, "T"), lambda p: read_foreign(p, "cmap")]
    for read in readers:
        attempt(read, path)


def attempt(read: Callable[[Any], object], path: Path) -> None:
    """Read; the project's own errors are what is expected."""
    try:
        read(path)
    except DroGraspError as error:
        if not str(error):
            raise AssertionError("an error without a message") from error


TARGETS = {
    "urdf": Target(_description("hand.urdf", URDF), load_hand, 14),
    "mjcf": Target(_description("hand.xml", MJCF), load_hand, 10),
    "linked": Target(_description("hand.xml", CONNECTED), load_hand, 8), "mesh": Target(_mesh, load_object, 14),
    "cloud": Target(_cloud, _read_cloud, 10), "depth": Target(_depth, _read_depth, 4), "robot": Target(_robot, load_robot, 10),
    "grasps": Target(_grasps, _read_grasps, 12),
    "weights": Target(_tensors("weights.safetensors", "dro_grasp_weights"), _read_weights, 10),
    "bundle": Target(_tensors("bundle.safetensors", "dro_grasp_bundle"), load_bundle, 8),
    "checkpoint": Target(_plain(CHECKPOINT), _read_run, 4), "log": Target(_plain(LOG, text=True), _read_run, 2),
    "foreign": Target(_foreign, _read_foreign, 6), "frame": Target(_json, lambda p: read_motion(p, "T_frame_camera"), 4),
    "upload": Target(_plain("hand.zip"), _read_upload, 2), "path": Target(_path, _read_path, 1),
    "cache": Target(_plain("cache.npz"), lambda p: cached_arrays(p.stem, dict), 2),
}
"""All kinds."""
