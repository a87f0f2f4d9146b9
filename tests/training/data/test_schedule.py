"""The data engine: order, sizes, resumption, failures that stay with their pair, and one real run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh

from dro_grasp import extras
from dro_grasp.cli.main import main
from dro_grasp.errors import ObjectError, OptionError, OutputError
from dro_grasp.grasps import grasp_file
from dro_grasp.grasps.batch import DUPLICATE_DISTANCE, GraspBatch
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.cutting import CutShortError
from dro_grasp.optimize.synthesis import SynthesisConfig
from dro_grasp.simulation.trial import simulate
from dro_grasp.training.data.collections.collection import read_collection
from dro_grasp.training.data.engine import schedule as engine, worker
from dro_grasp.training.data.engine.schedule import PairState, next_pairs, synthesize_dataset
from dro_grasp.training.data.engine.shards import Shard, Yield, find_shards
from dro_grasp.training.data.engine.worker import EngineConfig, make_shards, shard_seed
from tests.helpers.engine_work import GRASPS
from tests.helpers.here_pool import HerePool, run
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.one_object import settle, valid_grasps

TINY = EngineConfig(
    "strict", candidates=64, min_candidates=64, trial_share=0.5, synthesis=SynthesisConfig(steps=80, batch_size=64))
SMALL = replace(TINY, candidates=32, min_candidates=32, synthesis=SynthesisConfig(steps=60, batch_size=32))


def test_every_pair_gets_its_first_shard_before_any_gets_its_second(tmp_path):
    report, tasks, _ = run(tmp_path, ["a", "b"], ["x", "y", "z"], 12)
    assert [t.shard.round for t in tasks] == [0] * 6 + [1] * 6 + [2] * 6
    assert report.grasps == report.added == 18 * GRASPS
    assert report.shards == 18
    assert not report.failures


def test_a_device_without_the_extra_for_trials_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "require_device", lambda name: None)
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    config = EngineConfig(synthesis=SynthesisConfig(device="cuda:1"))
    with pytest.raises(OptionError, match=r"warp, mujoco_warp.*dro-grasp\[gpu\]"):
        synthesize_dataset(["gripper3"], ["can"], 1, tmp_path / "new", 1, 0, config)
    assert not (tmp_path / "new").exists()


def test_hands_take_turns_so_that_a_run_that_ends_early_has_grasps_of_all(tmp_path):
    _, tasks, _ = run(tmp_path, ["a", "b", "c"], ["x", "y", "z"], 5)
    hands = [task.shard.hand for task in tasks]
    assert [hands[:3], hands[3:6], hands[6:]] == [["a", "b", "c"]] * 3
    assert len({(task.shard.hand, task.shard.object) for task in tasks}) == 9


def test_a_rerun_does_only_what_is_missing_and_a_higher_goal_extends(tmp_path):
    run(tmp_path, ["a"], ["x", "y"], 10)
    before = {s: s.path(tmp_path).read_bytes() for s in find_shards(tmp_path)}
    Shard("a", "y", 1).path(tmp_path).unlink()
    report, tasks, _ = run(tmp_path, ["a"], ["x", "y"], 10)
    assert [t.shard for t in tasks] == [Shard("a", "y", 1)]
    assert (report.grasps, report.added) == (20, 5)
    report, tasks, _ = run(tmp_path, ["a"], ["x", "y"], 20)
    assert [t.shard.round for t in tasks] == [2, 2, 3, 3]
    assert report.grasps == 40
    assert all(shard.path(tmp_path).read_bytes() == content for shard, content in before.items())


def test_later_shards_know_the_earlier_ones_and_are_as_large_as_the_yield_asks(tmp_path):
    _, tasks, _ = run(tmp_path, ["a"], ["x"], 100, config=EngineConfig(candidates=64, max_candidates=512))
    assert [len(t.earlier) for t in tasks[:4]] == [0, 1, 2, 3]
    assert GraspBatch.load(Shard("a", "x", 0).path(tmp_path)).object == ("x",) * GRASPS
    # 5 of 64, so 95 more would take 1216: the largest shard there is.
    assert [t.candidates for t in tasks[:2]] == [64, 512]
    assert [PairState().next_candidates(goal, EngineConfig()) for goal in (1, 12, 1000)] == [64, 128, 256]
    state = PairState(total=Yield(candidates=256, valid=100))
    assert state.next_candidates(150, EngineConfig()) == 128
    assert state.next_candidates(180, EngineConfig()) == 256  # 205 in steps of 64


@pytest.mark.parametrize("damage", [b"PAR1", b""])
def test_a_damaged_shard_is_named_and_made_again(tmp_path, damage):
    run(tmp_path, ["a"], ["x"], 10)
    Shard("a", "x", 0).path(tmp_path).write_bytes(damage)
    report, tasks, lines = run(tmp_path, ["a"], ["x"], 10)
    assert [t.shard for t in tasks] == [Shard("a", "x", 0)]
    assert report.grasps == 10
    assert any("00000.parquet" in line and "made again" in line for line in lines)


def test_a_shard_of_another_version_is_named_and_made_again(tmp_path, monkeypatch):
    path = Shard("a", "x", 0).path(tmp_path)
    monkeypatch.setattr(grasp_file, "FORMAT_VERSION", 9)
    run(tmp_path, ["a"], ["x"], 5)
    monkeypatch.undo()
    _, tasks, lines = run(tmp_path, ["a"], ["x"], 5)
    assert len(tasks) == 1
    assert any("version 9" in line for line in lines)
    assert len(GraspBatch.load(path)) == GRASPS


@pytest.mark.parametrize(
    ("hand", "obj", "reason"), [("broken", "x", "no hand is called"), ("a", "unsplit", "CoACD found none")])
def test_a_failing_pair_is_reported_and_the_others_go_on(tmp_path, hand, obj, reason):
    report, tasks, lines = run(tmp_path, [hand, "good"], [obj, "y"], 10)
    assert all(reason in why for why in report.failures.values())
    assert {s.object for s in find_shards(tmp_path) if s.hand == "good"} >= {"y"}
    assert sum(t.shard == Shard(hand, obj, 0) for t in tasks) == 1
    assert any(f"{hand} on {obj}: " in line and reason in line for line in lines)


def test_a_barren_pair_is_given_up_with_the_main_reason_and_not_tried_again(tmp_path):
    report, tasks, _ = run(tmp_path, ["a"], ["barren", "x"], 10)
    assert report.failures["a", "barren"] == "0 grasps, none in the last 3 rounds: slipped (100% of the tested candidates)"
    assert sum(t.shard.object == "barren" for t in tasks) == EngineConfig().max_barren_rounds
    report, tasks, _ = run(tmp_path, ["a"], ["barren", "x"], 10)
    assert not tasks
    assert ("a", "barren") in report.failures


def test_a_pair_that_eats_candidates_is_given_up(tmp_path):
    report, _, _ = run(tmp_path, ["a"], ["x"], 1000, config=EngineConfig(candidate_budget=2000))
    assert "given up" in report.failures["a", "x"]
    assert report.grasps < 1000


def test_a_disk_that_refuses_stops_the_run_with_everything_before_it(tmp_path, monkeypatch):
    calls = []

    def refuse(self, payload: bytes, folder: Path) -> None:
        calls.append(self)
        if len(calls) == 3:
            raise OutputError("cannot write: No space left on device")
        original(self, payload, folder)

    original = Shard.save
    monkeypatch.setattr(Shard, "save", refuse)
    with pytest.raises(OutputError, match="No space"):
        run(tmp_path, ["a"], ["x"], 50)
    assert [s.round for s in find_shards(tmp_path)] == [0, 1]
    monkeypatch.undo()
    report, tasks, _ = run(tmp_path, ["a"], ["x"], 50)
    assert tasks[0].shard.round == 2
    assert report.grasps == 50


def test_the_next_pair_is_idle_and_has_the_fewest_rounds():
    states = {("a", "x"): PairState(done={0, 1}), ("a", "y"): PairState(done={0}), ("a", "z"): PairState()}
    assert next_pairs(states, {("a", "z")}, 10, EngineConfig()) == [("a", "y")]
    states["a", "y"].total = Yield(valid=10)
    assert next_pairs(states, {("a", "z")}, 10, EngineConfig()) == [("a", "x")]


def test_an_object_that_is_being_prepared_is_left_to_one_worker():
    states = {(hand, obj): PairState() for hand in "ab" for obj in "xy"}
    assert next_pairs(states, {("a", "x")}, 10, EngineConfig()) == [("b", "y")]
    states["a", "x"].total = Yield(candidates=64)  # then its parts are in the cache
    states["a", "y"].done = states["b", "y"].done = {0}
    assert next_pairs(states, {("a", "x")}, 10, EngineConfig()) == [("b", "x")]


def test_a_run_that_ends_early_has_all_hands_and_all_objects():
    states = {(hand, obj): PairState() for hand in "abc" for obj in "vwxyz"}
    for _ in range(5):
        states[next_pairs(states, set(), 10, EngineConfig())[0]].done = {0}
    begun = [pair for pair, state in states.items() if state.done]
    assert {hand for hand, _ in begun} == set("abc")
    assert {obj for _, obj in begun} == set("vwxyz")


def test_pairs_of_one_hand_are_made_together_and_shards_are_larger_where_few_are_left(tmp_path):
    config = EngineConfig(candidates=64, min_candidates=64, together=2)
    (tmp_path / "data").mkdir()
    report, tasks, _ = run(tmp_path / "data", ["a", "b"], ["x", "y", "z"], 5, config=config)
    hands, sizes = [task.shard.hand for task in tasks], [task.candidates for task in tasks]
    assert hands == ["a", "a", "b", "b", "a", "b"]
    assert len({(task.shard.hand, task.shard.object) for task in tasks}) == 6
    assert sizes == [64, 64, 64, 64, 128, 128]
    assert report.shards == 6


def test_a_pair_on_which_a_worker_died_is_alone():
    states = {("a", obj): PairState() for obj in "xyz"}
    states["a", "x"].crashes = 1
    config = EngineConfig(together=3)
    assert next_pairs(states, set(), 10, config) == [("a", "y"), ("a", "z")]
    assert next_pairs(states, {("a", "y"), ("a", "z")}, 10, config) == [("a", "x")]
    assert next_pairs({}, set(), 10, config) == []


def test_an_error_of_one_costs_those_that_are_made_with_it_nothing(tmp_path, monkeypatch):
    def load(source, **options):
        if source == "broken":
            raise ObjectError("the mesh is broken; repair it")
        return load_object(source, **options)

    monkeypatch.setattr(worker, "_object", load)
    (tmp_path / "alone").mkdir()
    (tmp_path / "together").mkdir()
    made = [run(tmp_path / name, ["gripper3"], ["can", "broken", "sphere"], 2, make_shards, config=replace(SMALL, together=n))
            for name, n in (("alone", 1), ("together", 3))]
    assert all(report.failures == {("gripper3", "broken"): "the mesh is broken; repair it"} for report, *_ in made)
    alone, together = ({shard: GraspBatch.load(shard.path(tmp_path / name)) for shard in find_shards(tmp_path / name)}
                       for name in ("alone", "together"))
    assert len(together) >= 2
    for shard in [shard for shard in alone if shard.round == 0]:
        assert torch.equal(alone[shard].joints, together[shard].joints)


def test_as_many_as_none_are_not_made_together():
    with pytest.raises(OptionError, match="together is 0"):
        EngineConfig(together=0)


def test_shards_have_seeds_of_their_own():
    shards = [Shard(h, o, r) for h in "ab" for o in "xy" for r in range(3)]
    seeds = {shard_seed(seed, shard) for seed in (0, 1) for shard in shards}
    assert len(seeds) == 24
    assert shard_seed(0, Shard("a", "x", 0)) == shard_seed(0, Shard("a", "x", 0))
    assert max(seeds) < 2**63


def test_impossible_requests_are_refused_before_the_work(tmp_path):
    for goal, folder, error in (
        (0, tmp_path, OptionError), (1, tmp_path / "file" / "folder", OutputError), (1, tmp_path / "file", OutputError)
    ):
        (tmp_path / "file").write_text("")
        with pytest.raises(error):
            synthesize_dataset(["a"], ["x"], goal, folder, workers=HerePool)


def test_a_missing_gpu_is_told_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    config = EngineConfig(synthesis=SynthesisConfig(device="cuda"))
    with pytest.raises(OptionError, match=r"device is 'cuda', but .* use device='cpu'"):
        synthesize_dataset(["a"], ["x"], 1, tmp_path, config=config)


def test_real_shards_hold_valid_grasps_repeat_and_add_up(tmp_path):
    report, tasks, _ = run(tmp_path, ["barrett"], ["can"], 12, make_shards, config=TINY)
    assert not report.failures
    (pair,) = read_collection(tmp_path)
    found, made = pair.grasps, pair.made
    assert len(found) == report.grasps == made.valid >= 12
    assert len(tasks) > 1
    assert bool(found.success.all())
    assert found.penetration.max() < 0.005  # [m]
    assert set(found.split) == {"train"}
    assert set(found.protocol) == {"strict/1"}
    assert all(len(links) >= 2 for links in found.extra["contact_links"])
    assert {name for name in found.extra if name.startswith("energy_")} >= {"energy_force_closure", "energy_penetration"}
    assert made.candidates == sum(t.candidates for t in tasks)
    assert made.candidates == made.ranked_out + made.deep + made.moved + made.evaluated
    assert made.cpu_seconds > 0
    points = loaded_hand("barrett").with_points(64).points(found.joints, found.T_object_wrist)
    apart = (points[:, None] - points).norm(dim=-1).mean(-1) + torch.eye(len(found))
    assert apart.min() >= DUPLICATE_DISTANCE  # also across shards
    hand, can = worker._hand("barrett"), worker._object("can", scale=1.0)
    again, _ = valid_grasps(hand, can, shard_seed(0, Shard("barrett", "can", 0)), TINY)
    assert torch.equal(again.joints, GraspBatch.load(Shard("barrett", "can", 0).path(tmp_path)).joints)


@pytest.mark.slow
def test_the_same_command_makes_the_same_grasps_however_many_work(tmp_path):
    """In this process, and in two others."""
    found = []
    for name, workers in (("here", lambda job: HerePool(job, make_shards)), ("there", 2)):
        folder = tmp_path / name
        synthesize_dataset(["gripper3"], ["can", "sphere"], 2, folder, workers, config=SMALL, progress=lambda _: None)
        found.append([GraspBatch.load(shard.path(folder)) for shard in find_shards(folder)])
    assert len(found[0]) >= 2
    assert min(map(len, found[0])) > 0
    for one, two in zip(*found, strict=True):
        assert torch.equal(one.joints, two.joints)
        assert torch.equal(one.T_object_wrist, two.T_object_wrist)


def test_a_success_that_hardly_anything_touches_is_not_kept():
    hand, can = loaded_hand("barrett"), load_object("can")
    kept, made = valid_grasps(hand, can, 3, TINY)
    strict, fewer = valid_grasps(hand, can, 3, replace(TINY, min_contact_links=5))
    held = [len(links) for links in kept.extra["contact_links"]]
    assert min(held) < 5 <= max(held)
    assert made.failures.get("held by too few links", 0) == 0
    assert fewer.failures["held by too few links"] == sum(n < 5 for n in held)
    assert len(strict) == sum(n >= 5 for n in held)


def test_idle_fingers_of_new_grasps_close():
    """The same candidates; closing changes which are near-duplicates, so the wrist tells which grasp is which."""
    hand, can = loaded_hand("allegro"), load_object("can")
    config = EngineConfig("strict", candidates=48, synthesis=SynthesisConfig(steps=60, batch_size=48))
    left, closed = (valid_grasps(hand, can, 2, replace(config, close_fingers=close))[0] for close in (False, True))
    assert "relabelled" not in left.extra
    marked = closed.extra["relabelled"]
    assert 0 < int(marked.sum()) < len(closed)
    before = {tuple(T.flatten().tolist()): row for row, T in enumerate(left.T_object_wrist)}
    rows = [before[tuple(T.flatten().tolist())] for T in closed.T_object_wrist]
    was = left[rows]
    assert torch.equal(marked, (closed.joints != was.joints).any(1))
    assert bool((closed.fingers_in_contact >= was.fingers_in_contact).all())
    assert float(closed.fingers_in_contact.mean()) > float(was.fingers_in_contact.mean())
    again = simulate(hand, can, closed, "strict")
    assert bool(again.success.all())


def test_settled_labels_move_only_joints_that_hold(tmp_path):

    hand, can = loaded_hand("allegro"), load_object("can")
    grasps = valid_grasps(hand, can, 1, EngineConfig(
        "strict", candidates=48, trial_share=0.5, settle=False, close_fingers=False,
        synthesis=SynthesisConfig(steps=80, batch_size=48)))[0]
    settled = settle(hand, can, grasps, "strict")
    held = simulate(hand, can, grasps, "strict").contact_links
    moved = settled.joints != grasps.joints
    for row, links in zip(moved, held, strict=True):
        touching = [hand.tree.link_names.index(link) for link in links]
        below = (hand.tree.descends[touching].float() @ (hand.tree.link_coupling != 0).float()).sum(0) > 0
        assert not row[~below].any()
    assert moved.any()


def test_a_hand_that_cannot_hold_the_object_is_told_why(tmp_path):
    trimesh.creation.box((0.3, 0.3, 0.3)).export(tmp_path / "house.stl")
    config = replace(SMALL, max_barren_rounds=1)
    (tmp_path / "data").mkdir()
    report, _, _ = run(tmp_path / "data", ["gripper3"], [str(tmp_path / "house.stl"), "can"], 1, make_shards, config=config)
    (why,) = report.failures.values()
    assert why.startswith("0 grasps, none in the last 1 rounds: ")
    assert "%" in why
    assert report.grasps >= 1  # of the can


def test_an_object_that_cannot_be_cut_is_told_in_one_line(tmp_path, monkeypatch):
    def fail(*args, **kwargs):
        raise CutShortError("assertion failed")

    monkeypatch.setattr("dro_grasp.objects.convex_parts.cut_apart", fail)
    monkeypatch.setenv("DRO_GRASP_CACHE", str(tmp_path / "cache"))
    torus = trimesh.creation.torus(0.05, 0.015)
    torus.export(tmp_path / "ring.stl")
    (tmp_path / "data").mkdir()
    report, _, lines = run(tmp_path / "data", ["barrett"], [str(tmp_path / "ring.stl")], 1, make_shards, config=TINY)
    why = report.failures["barrett", str(tmp_path / "ring.stl")]
    assert "cut into convex parts: CoACD failed (assertion failed), and V-HACD failed" in why
    assert any("ring.stl: the mesh cannot be cut" in line for line in lines)


def test_grasps_of_files_remember_them(tmp_path):
    trimesh.creation.icosphere(radius=0.03).export(tmp_path / "ball.stl")
    (tmp_path / "data").mkdir()
    run(tmp_path / "data", ["gripper3"], [str(tmp_path / "ball.stl")], 1, make_shards, config=replace(SMALL, scale=1.2))
    (pair,) = read_collection(tmp_path / "data")
    assert set(pair.grasps.extra["object_file"]) == {str(tmp_path / "ball.stl")}
    assert pair.grasps.extra["object_scale"].unique().tolist() == [pytest.approx(1.2)]
    assert set(pair.grasps.split) == {""}


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf")])
def test_a_time_that_is_none_is_refused(tmp_path, seconds):
    with pytest.raises(OptionError, match="seconds is "):
        synthesize_dataset(["a"], ["x"], 1, tmp_path / "data", workers=HerePool, config=EngineConfig(seconds=seconds))
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("option", "value"),
    [("--hand", "nowhere.urdf"), ("--hand", "barret"), ("--object", "nope.stl"), ("--object", "mugg"), ("--minutes", "-1"),
     ("--minutes", "0"), ("--minutes", "nan"), ("--grasps", "0"), ("--workers", "0"), ("--scale", "nan"), ("--idle", "1.5"),
     ("--idle", "nan"), ("--confirm", "0.5")],
)
def test_the_command_refuses_before_it_starts(tmp_path, monkeypatch, capsys, option, value):
    monkeypatch.setattr(engine, "synthesize_dataset", None)
    given = {"--hand": "barrett", "--object": "mug", "--output": str(tmp_path / "sy"), option: value}
    assert main(["synthesize", *(word for pair in given.items() for word in pair)]) == 2
    told = capsys.readouterr().err
    assert value in told
    named = option not in {"--hand", "--object"}
    assert told.replace("--", "").startswith(f"error: {option[2:]} is " if named else "error: no")
    assert option in told or not named
    assert not (tmp_path / "sy").exists()


def test_the_address_of_a_cluster_needs_one(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(engine, "synthesize_dataset", None)
    given = ["synthesize", "--hand", "barrett", "--object", "mug", "--output", str(tmp_path / "sy")]
    assert main([*given, "--ray-address", "auto"]) == 2
    assert "--ray-address is that of a Ray cluster; add --engine ray, or leave it out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "idle", "closes"), [([], 0.6, True), (["--idle", "0.2", "--keep-idle-fingers"], 0.2, False)])
def test_the_command_asks_for_idleness(tmp_path, monkeypatch, options, idle, closes):
    asked = []
    monkeypatch.setattr(
        engine, "synthesize_dataset", lambda *given, **_: asked.append(given[6]) or engine.DatasetReport(1, 1, 1, 1.0, {}))
    assert main(["synthesize", "--hand", "barrett", "--object", "mug", "--output", str(tmp_path / "sy"), *options]) == 0
    assert (asked[0].synthesis.contacts.idle, asked[0].close_fingers) == (idle, closes)


@pytest.mark.parametrize("kind", ["object", "hand"])
def test_files_of_one_name_are_refused_before_the_work(tmp_path, monkeypatch, capsys, kind):
    monkeypatch.setattr(engine, "synthesize_dataset", lambda *_, **__: engine.DatasetReport(1, 1, 1, 1.0, {}))
    files = [tmp_path / folder / ("mug.stl" if kind == "object" else "barrett.urdf") for folder in ("a", "b")]
    for file in files:
        file.parent.mkdir()
        file.touch()
    same = files[1].parent / ".." / "b" / files[1].name
    name = files[0].stem
    for given, refused in (([files[0], files[1]], True), ([files[0], name], True), ([files[1], same], False)):
        pair = {"hand": ["gripper3"], "object": ["can"], kind: list(map(str, given))}
        options = ["--hand", *pair["hand"], "--object", *pair["object"], "--output", str(tmp_path / "out")]
        assert main(["synthesize", *options]) == (2 if refused else 0)
        assert (f"{kind}s '{given[0]}' and '{given[1]}' are both called '{name}'" in capsys.readouterr().err) == refused
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("grasps", "failures", "code"), [(0, True, 2), (3, True, 0), (0, False, 0)])
@pytest.mark.parametrize("more", [[], ["--json"]])
def test_the_command_fails_when_nothing_came_of_it(tmp_path, monkeypatch, capsys, grasps, failures, code, more):
    report = engine.DatasetReport(grasps, grasps, 1, 1.0, {("barrett", "mug"): "slipped"} if failures else {})
    monkeypatch.setattr(engine, "synthesize_dataset", lambda *_, **__: report)
    assert main(["synthesize", "--hand", "barrett", "--object", "mug", "--output", str(tmp_path), *more]) == code
    said = capsys.readouterr()
    assert ("slipped" in said.out + said.err) == failures
