"""Training bundles: what comes back, what is refused, damaged files, and the commands that make and count them."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
from pathlib import Path

import grimp
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from dro_grasp.cli.main import main
from dro_grasp.errors import BundleError, GraspFileError, OptionError, OutputError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import with_sources
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import BUILTIN_FOLDER, load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.training.config import AugmentationConfig
from dro_grasp.training.data.bundle import training_file as bundle_module
from dro_grasp.training.data.bundle.training_file import SPLITS, ObjectCloud, load_bundle, split_of, write_bundle
from dro_grasp.training.data.collections.bundling import CLOUD_POINTS, make_bundle, sources
from dro_grasp.training.data.engine.shards import Shard
from dro_grasp.training.samples import SampleSource
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.tiny_bundle import SEMIAXES, TINY, ellipsoid, made_up_grasps, tiny_bundle
from tests.helpers.toy_hand import toy_hand

HAND = toy_hand()
BALL = {"ball": ellipsoid(SEMIAXES["ball"])}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "bundle.safetensors"


def test_clouds_come_back_within_half_a_level(path: Path) -> None:
    bundle = tiny_bundle(path)
    assert bundle.object_names == tuple(SEMIAXES)
    for name, axes in SEMIAXES.items():
        given, read = ellipsoid(axes), bundle.objects[name]
        level = (given.points.amax(0) - given.points.amin(0)) / 65535
        assert bool(((given.points - read.points).abs() <= 0.51 * level + 1e-9).all())
        assert float((given.normals - read.normals).abs().max()) < 1 / 127
        torch.testing.assert_close(read.normals.norm(dim=-1), torch.ones(len(read.normals)))


def test_a_bundle_may_be_named_from_home(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(path.parent))
    assert tiny_bundle(Path("~") / path.name).n_grasps == 48
    assert path.is_file()


def test_a_flat_cloud_comes_back(path: Path) -> None:
    points = torch.rand(50, 3) * torch.tensor([0.1, 0.1, 0.0]) + 0.3
    flat = ObjectCloud(points, torch.tensor([[0.0, 0.0, 1.0]]).repeat(50, 1))
    read = write_bundle(path, [HAND], {"ball": flat}, [made_up_grasps(HAND)]).objects["ball"]
    torch.testing.assert_close(read.points, points, atol=1e-6, rtol=0)


def test_grasps_and_hands_come_back(path: Path) -> None:
    bundle = tiny_bundle(path)
    given = GraspBatch.concatenate([made_up_grasps(HAND, name, seed=i) for i, name in enumerate(SEMIAXES)])
    read = bundle.grasps["toy"]
    torch.testing.assert_close(read.T_object_wrist, given.T_object_wrist, atol=1e-6, rtol=0)
    assert torch.equal(read.joints, given.joints)
    assert [bundle.object_names[i] for i in read.object_index] == list(given.object)
    hand = bundle.hands["toy"]
    for field in dataclasses.fields(Hand):
        if field.name not in {"tree", "description"}:
            ours, theirs = getattr(hand, field.name), getattr(HAND, field.name)
            assert torch.equal(ours, theirs) if isinstance(ours, torch.Tensor) else ours == theirs, field.name
    assert torch.equal(hand.points(read.joints, read.T_object_wrist), HAND.points(read.joints, read.T_object_wrist))
    assert bundle.summary() == {"hands": {"toy": 48}, "objects": 2, "grasps": 48}
    assert path.stat().st_mode & 0o777 == 0o644


def test_what_training_may_not_have_is_refused(path: Path) -> None:
    good, other = made_up_grasps(HAND), dataclasses.replace(HAND, name="other", sha256="other")
    for split in ("validate", "test", "hard_test"):
        with pytest.raises(BundleError, match="grasps on ball are held out"):
            write_bundle(path, [HAND], BALL, [good, made_up_grasps(HAND, split=split)])
    with pytest.raises(BundleError, match="grasps of other"):
        write_bundle(path, [HAND], BALL, [good, made_up_grasps(other)])
    with pytest.raises(BundleError, match=r"grasps of toy .* other versions"):
        write_bundle(path, [HAND], BALL, [good, made_up_grasps(dataclasses.replace(HAND, sha256="edited"))])
    with pytest.raises(BundleError, match="no cloud was given for objects cube"):
        write_bundle(path, [HAND], BALL, [made_up_grasps(HAND, "cube")])
    with pytest.raises(BundleError, match="no grasps of hand 'other'"):
        write_bundle(path, [HAND, other], BALL, [good])
    with pytest.raises(BundleError, match="no grasps were given"):
        write_bundle(path, [], {}, [])
    broken = dataclasses.replace(BALL["ball"], points=BALL["ball"].points * torch.nan)
    with pytest.raises(BundleError, match="'ball' has non-finite"):
        write_bundle(path, [HAND], {"ball": broken}, [good])
    assert list(path.parent.iterdir()) == []


def test_hands_without_grasps_come_back(path: Path) -> None:
    more = dataclasses.replace(HAND, name="more", sha256="more")
    bundle = write_bundle(path, [HAND], BALL, [made_up_grasps(HAND)], without_grasps=[more])
    assert bundle.summary()["hands"] == {"toy": 24, "more": 0}
    joints = HAND.canonical_joints(0.7)
    assert torch.equal(bundle.hands["more"].points(joints), HAND.points(joints))
    assert bundle.grasps["more"].T_object_wrist.shape == (0, 4, 4)
    with pytest.raises(BundleError, match="toy is the name of more than one hand"):
        write_bundle(path, [HAND], BALL, [made_up_grasps(HAND)], without_grasps=[dataclasses.replace(HAND, sha256="other")])


def test_too_large_is_refused_before_writing(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny_bundle(path)
    size = path.stat().st_size
    monkeypatch.setattr(bundle_module, "MAX_BYTES", size // 2)
    monkeypatch.setattr(bundle_module, "save_file", None)
    with pytest.raises(BundleError, match=r"at most .* MB"):
        tiny_bundle(path)
    assert path.stat().st_size == size


def change(path: Path, how: str) -> None:
    """Damage a bundle."""
    whole = path.read_bytes()
    with safe_open(path, "pt") as file:
        header = json.loads(file.metadata()["dro_grasp_bundle"])
        tensors = {key: file.get_tensor(key) for key in file.keys()}
    path.unlink()
    if how == "cut short":
        path.write_bytes(whole[:-100])
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "another format":
        path.write_bytes(b"PAR1" * 100)
    elif how == "other weights":
        save_file(tensors, path)
    elif how == "strange header":
        save_file(tensors, path, metadata={"dro_grasp_bundle": "[1]"})
    elif how == "another version":
        save_file(tensors, path, metadata={"dro_grasp_bundle": json.dumps(header | {"format_version": 99})})
    else:
        save_file({k: v for k, v in tensors.items() if "joints" not in k}, path,
                  metadata={"dro_grasp_bundle": json.dumps(header)})


@pytest.mark.parametrize(
    ("how", "word"),
    [("cut short", "cut short"), ("empty", "cut short"),
     ("another format", "expected a bundle"), ("other weights", "no bundle"),
     ("strange header", "no bundle"), ("another version", "version 99, expected 1"), ("a part missing", r"grasps\.0\.joints")],
)
def test_a_damaged_bundle_is_refused(path: Path, how: str, word: str) -> None:
    tiny_bundle(path)
    change(path, how)
    with pytest.raises(BundleError, match=word):
        load_bundle(path)


def test_a_missing_bundle_is_refused(path: Path) -> None:
    with pytest.raises(BundleError, match="no bundle at"):
        load_bundle(path)


def test_output_that_cannot_be_written_leaves_nothing(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match="cannot write"):
        tiny_bundle(path.parent / "none" / "bundle.safetensors")
    (path.parent / "folder").mkdir()
    with pytest.raises(OutputError, match="cannot write"):
        tiny_bundle(path.parent / "folder")
    monkeypatch.setattr(bundle_module, "save_file", full)
    with pytest.raises(OutputError, match="No space left"):
        tiny_bundle(path)
    assert [p.name for p in path.parent.iterdir()] == ["folder"]


def test_samples_are_what_the_bundle_says(path: Path) -> None:
    source = SampleSource(tiny_bundle(path), TINY, AugmentationConfig(object_noise=0.0))
    drawn = source.draw("toy", 8, torch.Generator().manual_seed(0))
    assert drawn.grasp.shape == (8, TINY.n_hand, 3)
    assert drawn.obj.shape == drawn.normals.shape == drawn.obj_hand.shape == (8, TINY.n_object, 3)
    hand = drawn.hand
    # The true link poses carry the hand's points to the grasp, in the frame of object and grasp.
    T = drawn.T_frame_link[:, hand.link_index]
    moved = (T[..., :3, :3] @ hand.link_points[..., None])[..., 0] + T[..., :3, 3]
    torch.testing.assert_close(moved, drawn.grasp, atol=1e-6, rtol=0)
    torch.testing.assert_close(drawn.obj.mean(1), torch.zeros(8, 3), atol=1e-6, rtol=0)
    T_wrist = drawn.T_frame_link[:, 0]
    centre = (T_wrist[:, :3, :3] @ hand.grasp_centre_wrist) + T_wrist[:, :3, 3]
    axes = T_wrist[:, :3, :3] @ hand.palm_axes_wrist
    torch.testing.assert_close((centre[:, None] @ axes)[:, 0], drawn.position, atol=1e-6, rtol=0)
    torch.testing.assert_close(drawn.obj @ axes, drawn.obj_hand, atol=1e-6, rtol=0)
    # Placed hands differ from the true ones by a few degrees, so the frame's axes are nearly those of the hand.
    assert float((axes.diagonal(dim1=1, dim2=2).sum(1)).min()) > 2.9


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Shards of a built-in hand and of a file, on two objects, one of them held out."""
    home = tmp_path_factory.mktemp("dataset")
    own = home / "mine.urdf"
    shutil.copy(BUILTIN_FOLDER / "gripper3.urdf", own)
    own.write_text(own.read_text() + "<!-- another hash -->")
    for name in ("gripper3", str(own)):
        hand = load_hand(name)
        for obj, split in (("sphere", "train"), ("cube", "test")):
            for round_ in range(2):
                made = made_up_grasps(hand, obj, count=5, split=split, seed=round_)
                tried = made.replace(success=torch.arange(5) > 0, protocol=("strict/1",) * 5,
                                     object_sha256=(load_object(obj).sha256,) * 5)
                tried = with_sources(tried, name, obj, 1.0)
                Shard(name, obj, round_).save(tried.to_bytes(), home / "data")
    return home


def test_dataset_info_counts(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dataset", "info", str(dataset / "data"), "--json"]) == 0
    counts = {"cube": 10, "sphere": 10}
    expected = {"total": 40, "hands": {"gripper3": counts, str(dataset / "mine.urdf"): counts}}
    assert json.loads(capsys.readouterr().out) == expected


def test_dataset_bundle_packs_what_is_for_training(
    dataset: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    output = dataset / "bundle.safetensors"
    monkeypatch.setenv("HOME", str(dataset))
    assert main(["dataset", "bundle", str(dataset / "data"), "--output", "~/bundle.safetensors", "--json"]) == 0
    said = capsys.readouterr()
    assert "16 grasps outside split 'train' are left out" in said.err
    report = json.loads(said.out)
    assert report == {"output": str(output), "bytes": output.stat().st_size, "hands": {"gripper3": 8, "mine": 8},
                      "objects": 1, "grasps": 16}
    bundle = load_bundle(output)
    assert bundle.object_names == ("sphere",)
    expected = torch.cat([made_up_grasps(loaded_hand("gripper3"), "sphere", 5, seed=i).joints[1:] for i in range(2)])
    assert torch.equal(bundle.grasps["gripper3"].joints, expected)


@pytest.mark.parametrize(
    ("folder", "output", "word"),
    [("none", "b.safetensors", "no grasps at"), ("data", "none/b.safetensors", "create it first"),
     ("empty", "b.safetensors", "no grasps")],
)
def test_dataset_bundle_refuses(
    dataset: Path, capsys: pytest.CaptureFixture[str], folder: str, output: str, word: str
) -> None:
    (dataset / "empty").mkdir(exist_ok=True)
    assert main(["dataset", "bundle", str(dataset / folder), "--output", str(dataset / output)]) == 2
    assert word in capsys.readouterr().err


def test_no_index_takes_no_grasp() -> None:
    assert len(made_up_grasps(HAND)[[]]) == 0


def test_namesakes_are_not_mixed_up(tmp_path: Path) -> None:
    batches = []
    for folder in "ab":
        own = tmp_path / folder / "mine.urdf"
        own.parent.mkdir()
        own.write_text((BUILTIN_FOLDER / "gripper3.urdf").read_text() + f"<!-- {folder} -->")
        made = made_up_grasps(load_hand(own), "sphere", 2).replace(object_sha256=(load_object("sphere").sha256,) * 2)
        batches.append(with_sources(made, str(own), "sphere", 1.0))
    hands, clouds, _ = sources([batches[0], batches[0]])
    assert [hand.name for hand in hands] == ["mine"]
    assert list(clouds) == ["sphere"]
    with pytest.raises(BundleError, match="different hands are called mine"):
        sources(batches)


@pytest.mark.parametrize("unknown", ["hash of the hand", "hashes of the objects", "both", "the first object's hash"])
def test_grasps_whose_files_state_no_hash_are_bundled_with_what_they_name(path: Path, unknown: str) -> None:
    hand, batches = loaded_hand("gripper3"), []
    for name in ("sphere", "cube"):
        made = made_up_grasps(hand, name, 4, success=[True] * 4)
        hashes = (load_object(name).sha256,) * 4
        empty = 1 if unknown.startswith("the") else 0 if unknown == "hash of the hand" else 4
        made = made.replace(object_sha256=("",) * empty + hashes[empty:])
        batches.append(made if "objects" in unknown or "first" in unknown else made.replace(hand_sha256=""))
        batches[-1].save(path.with_name(f"{name}.parquet"))
    bundle, _ = make_bundle([path.with_name("sphere.parquet"), path.with_name("cube.parquet")], path, per_pair=2)
    assert bundle.summary() == {"hands": {"gripper3": 4}, "objects": 2, "grasps": 4}
    assert bundle.hands["gripper3"].sha256 == hand.sha256
    for name, cloud in bundle.objects.items():
        kept = torch.from_numpy(load_object(name).cloud[:CLOUD_POINTS])
        torch.testing.assert_close(cloud.points, kept, atol=1e-5, rtol=0)


def test_an_object_that_has_changed_is_refused_also_where_the_first_grasp_states_no_hash() -> None:
    grasps = made_up_grasps(loaded_hand("gripper3"), "sphere", 2).replace(object_sha256=("", "0123456789abcdef"))
    with pytest.raises(GraspFileError, match=r"another version of object .sphere. .hash 0123456789ab"):
        sources([grasps])


def test_an_object_that_has_changed_is_refused() -> None:
    hand = loaded_hand("gripper3")
    grasps = made_up_grasps(hand, "sphere", 2).replace(object_sha256=("0123456789abcdef",) * 2)
    with pytest.raises(GraspFileError, match=r"another version of object .sphere. .hash 0123456789ab"):
        sources([grasps])


def test_held_out_hands_enter_few_shot_bundles_only(path: Path) -> None:
    assert [split_of("assets/inspire", s) for s in ("train", "", "validate", "test")] == [
        "few_shot", "few_shot", "validate", "test"]
    assert split_of("assets/shadowhand", "train") == "train"
    grasps = made_up_grasps(HAND, "ball", 3, split="few_shot")
    with pytest.raises(BundleError, match="held out"):
        write_bundle(path, [HAND], BALL, [grasps])
    assert write_bundle(path, [HAND], BALL, [grasps], SPLITS["few_shot"]).n_grasps == 3
    with pytest.raises(BundleError, match="held out"):
        write_bundle(path, [HAND], BALL, [made_up_grasps(HAND, "ball", 3)], SPLITS["few_shot"])


def test_what_cannot_be_bundled_is_counted_by_split(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(*more: str) -> str:
        output = tmp_path / "b.safetensors"
        assert main(["dataset", "bundle", str(tmp_path / "mug.parquet"), "--output", str(output), *more]) == 2
        assert not output.exists()
        return capsys.readouterr().err

    tested = made_up_grasps(HAND, count=3, split="test")
    held = tested.replace(success=torch.ones(3, dtype=torch.bool), protocol=("strict/1",) * 3)
    held.save(tmp_path / "mug.parquet")
    told = refused()
    assert "no grasps of split 'train' were given, but 3 of split 'test'" in told
    assert "objects for training" in told
    assert "choose --split" not in told
    assert "no grasps of other were given, but of toy" in refused("--hands", "other")
    assert "no grasps of other were given, but of toy; name one of these with --hands" in refused("--hands", "toy", "other")
    with pytest.raises(OptionError, match="split is 'test'; choose train, few_shot, validate"):
        make_bundle([tmp_path / "mug.parquet"], tmp_path / "b.safetensors", split="test")
    held.replace(split=("validate", "validate", "test")).save(tmp_path / "mug.parquet")
    told = refused()
    assert "but 1 of split 'test', 2 of split 'validate'; choose --split validate, or" in told
    held.replace(success=torch.zeros(3, dtype=torch.bool)).save(tmp_path / "mug.parquet")
    assert "no grasps that held in a trial" in refused("--hands", "toy")


def test_the_bundle_needs_only_what_a_bare_training_machine_has():
    graph = grimp.build_graph("dro_grasp", include_external_packages=True, exclude_type_checking_imports=True)
    bundle = {"dro_grasp.training.data.bundle", *graph.find_descendants("dro_grasp.training.data.bundle")}
    needed = {name.partition(".")[0] for module in bundle for name in graph.find_upstream_modules(module)}
    assert needed - set(sys.stdlib_module_names) == {
        "dro_grasp", "filelock", "jaxtyping", "numpy", "pyarrow", "roma", "safetensors", "torch"}  # torch needs filelock
