"""The measures that benchmarks define themselves."""

from __future__ import annotations

import dataclasses
import itertools
import json
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import ttest_rel

from dro_grasp import extras
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.network.presets import PRESETS
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.predict import predictor
from dro_grasp.predict.config import GraspRequest, RetryConfig
from dro_grasp.predict.predictor import GraspPredictor, Prediction
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources import source as sources
from dro_grasp.predict.sources.controls import palm_facing_starts
from dro_grasp.predict.sources.source import Asked, Candidates, Source
from dro_grasp.simulation import warp_worlds
from dro_grasp.training import loop, pretraining
from dro_grasp.training.data.bundle.training_file import write_bundle
from dro_grasp.training.data.collections.filtering import FILTER
from dro_grasp.training.data.collections.importing import read_foreign
from dro_grasp.training.data.engine.shards import Shard, Yield, notes_of
from dro_grasp.training.data.engine.worker import EngineConfig, Wanted
from lab.benchmarks import (
    agreement,
    data_card,
    device,
    device_trials,
    dexgraspbench,
    dexgraspbench_official,
    gpu_table,
    returned,
)
from lab.benchmarks.report import ROOT, note
from lab.measurements import STORED
from lab.studies import paper_form
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.steady_grasps import steady_grasps
from tests.helpers.tiny_bundle import SEMIAXES, TINY, ellipsoid, made_up_grasps
from tests.helpers.warp_steps import State, Steps


def test_the_gain_by_pretraining_is_scipys_paired_interval() -> None:
    rates = torch.rand(2, 3, generator=torch.Generator().manual_seed(0)).tolist()
    pretrained, plain = (
        [{"seed": seed, "rows": [{"stage": "raw", "success": {"dro/1": (other, 0, 1)}} for other in (0.5, rate)]}
         for seed, rate in enumerate(row)] for row in rates)
    interval = ttest_rel(*rates).confidence_interval()
    expected = 50 * (interval.low + interval.high), 50 * (interval.high - interval.low)
    (told,) = paper_form.gains(list(reversed(pretrained)), plain)
    assert f"under dro/1, raw: {expected[0]:+.1f} +- {expected[1]:.1f} points" in told
    (alone,) = paper_form.gains(pretrained[:1], plain)
    assert f"{100 * (rates[0][0] - rates[1][0]):+.1f} points (one seed)" in alone
    assert paper_form.gains([], plain) == paper_form.gains(pretrained[:1], plain[1:]) == []


def test_kappa_is_zero_for_a_judge_who_guesses_and_one_for_the_same_judge() -> None:
    """Against counts: kappa is (p - e) / (1 - e), of the table of both judges."""
    generator = torch.Generator().manual_seed(0)
    one = torch.rand(20000, generator=generator) < 0.7
    guess, noise = torch.rand(20000, generator=generator) < 0.7, torch.rand(20000, generator=generator) < 0.1
    assert agreement.kappa(one, one) == 1.0
    assert abs(agreement.kappa(one, guess)) < 0.03
    other = one ^ noise
    table = np.histogram2d(one.numpy().astype(int), other.numpy().astype(int), bins=2)[0] / len(one)
    chance = float((table.sum(1) * table.sum(0)).sum())
    assert agreement.kappa(one, other) == pytest.approx((np.trace(table) - chance) / (1 - chance))
    assert agreement.kappa(torch.ones(4, dtype=torch.bool), torch.ones(4, dtype=torch.bool)) == 1.0


def test_outcomes_are_compared_with_those_of_the_protocol_itself(capsys: pytest.CaptureFixture[str]) -> None:
    agreement.main("--hands gripper3 --objects can --num 3 --protocols carry --workers 1 --json".split())
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["setting"] for row in rows] == ["its own", *agreement.CHANGES]
    assert (rows[0]["same"], rows[0]["kappa"]) == (3, 1.0)
    assert all(abs(row["held"] - rows[0]["held"]) <= 3 - row["same"] for row in rows)


@pytest.mark.slow
def test_the_papers_form_is_trained_and_measured_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    hand = loaded_hand("gripper3")
    monkeypatch.setitem(PRESETS, "paper-slim", dataclasses.replace(TINY, frame="object"))
    grasps = [made_up_grasps(hand, name) for name in SEMIAXES]
    write_bundle(tmp_path / "bundle.safetensors", [hand], {k: ellipsoid(v) for k, v in SEMIAXES.items()}, grasps)
    command = ["--bundle", str(tmp_path / "bundle.safetensors"), "--validation", str(tmp_path / "bundle.safetensors"),
               "--output", str(tmp_path / "out"), "--hands", "gripper3", "--objects", "sphere", "--num", "1", "--steps", "2",
               "--pretraining-steps", "2", "--seeds", "0"]
    for stage in (loop, pretraining):
        monkeypatch.setattr(stage, "recalibrate", lambda *_: None)
    paper_form.main(command)
    told = capsys.readouterr().out
    assert "pretraining adds under strict/1, refined, ranked:" in told
    assert "z carries" in told
    monkeypatch.setattr(paper_form, "train", None)
    monkeypatch.setattr(paper_form, "benchmark", None)
    for weights in (tmp_path / "out").glob("*.safetensors"):
        weights.unlink()  # results alone are enough
    paper_form.main([*command, "--json"])
    found = json.loads(capsys.readouterr().out)
    assert [(r["row"], r["seed"], len(r["rows"])) for name in ("pretrained", "not pretrained") for r in found[name]] == [
        ("pretrained", 0, 3), ("not pretrained", 0, 3)]


def test_grasps_go_to_dexgraspbench_as_its_own_come_from_it(tmp_path: Path) -> None:
    hand = loaded_hand("shadowhand")
    grasps = made_up_grasps(hand, count=3)
    closed = grasps.replace(pregrasp_joints=0.8 * grasps.joints, squeeze_joints=1.1 * grasps.joints)
    back = []
    for i, entry in enumerate(dexgraspbench_official.entries(hand, closed, "some/object", 0.1)):
        np.save(tmp_path / f"{i}.npy", np.array(entry, dtype=object), allow_pickle=True)
        back += read_foreign(tmp_path / f"{i}.npy", "dexgraspbench")
    made = dexgraspbench.as_batch(hand, load_object("sphere"), back)
    assert [grasp.scale for grasp in back] == [0.1] * 3
    assert torch.allclose(made.T_object_wrist, closed.T_object_wrist, atol=1e-6)
    for posture in ("joints", "pregrasp_joints", "squeeze_joints"):
        assert torch.allclose(getattr(made, posture), getattr(closed, posture), atol=1e-6)


def test_what_a_filter_keeps_is_counted_with_its_diversity(tmp_path: Path) -> None:
    """Of two pairs one is filtered: counts and diversity, by SciPy, are of this one alone, before and after."""
    hand, made = loaded_hand("barrett"), []
    for name, seed in (("can", 0), ("sphere", 1)):
        starts = palm_facing_starts(hand, load_object(name), num=6, seed=seed)
        made.append(starts.replace(trial_success=torch.ones(6, dtype=torch.bool), protocol=("strict/1",) * 6))
    GraspBatch.concatenate(made).save(tmp_path / "barrett.parquet")
    rows = [1, 3, 4]
    tally = {"input": "", "grasps": 6, "failures": {"turned": 2, "lost": 1}, "remade": 1}
    Shard("barrett", "can", 0).save(made[0][rows].to_bytes(notes_of(Yield()) | {FILTER: tally}), tmp_path / "labels")
    (row, total), reasons = data_card.kept_rows(tmp_path, tmp_path / "labels")
    assert reasons == {"turned": 2, "lost": 1}
    told = dict(zip(data_card.KEPT, row, strict=True))
    assert [told[name] for name in ("hand", "pairs", "grasps", "kept", "made anew", "fewest")] == [
        "barrett", "1", "6", "3", "1", "3"]
    assert told["kept [%]"] == "50.0 [19-81]"
    assert total[:6] == ["all", "1", "6", "3", "50.0 [19-81]", "1"]
    for batch, names in ((made[0], ("diversity", "wrist", "joints")), (
            made[0][rows], ("of kept", "of kept wrist", "of kept joints"))):
        T = batch.T_object_wrist.double().numpy()
        wrist = np.concatenate([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_euler("xyz")], 1).std(0, ddof=1)
        joints = batch.joints.double().numpy().std(0, ddof=1)
        wanted = [np.concatenate([wrist, joints]).mean(), wrist.mean(), joints.mean()]
        assert [float(told[name]) for name in names] == pytest.approx(wanted, abs=6e-4)


def test_a_returned_grasp_takes_its_candidates_with_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The requests are those of `predict` with its defaults; time, by a clock of its own, is for what was returned."""
    asked, predict, clock = [], GraspPredictor.run, itertools.count(0.0, 0.5)

    def run(self: GraspPredictor, problem: GraspProblem, request: GraspRequest) -> Prediction:
        asked.append(request)
        return predict(self, problem, request)

    monkeypatch.setattr(GraspPredictor, "run", run)
    monkeypatch.setattr(returned, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    returned.main("--num 2 --hands gripper3 --objects can --seeds 1 --json".split())
    assert json.loads(capsys.readouterr().out)["seconds_a_grasp"] == {"2": 0.25}
    GraspPredictor().predict(loaded_hand("gripper3"), load_object("can"), 2, 0)
    assert asked[-2] == asked[-1]


def _noted(path: Path) -> dict[str, dict[str, float]]:
    """What a benchmark appended to a file, by name."""
    return {one["name"]: one for one in map(json.loads, path.read_text().splitlines())}


@pytest.mark.parametrize("first", [2, 16])
def test_candidates_a_second_are_of_those_that_were_made(first: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of sixteen that may be made, half settle where all are not asked for at first: counts are the sources' own."""
    made, propose = [], sources.ask_all

    def counted(source: Source, asked: list[Asked], *given: object) -> list[Candidates]:
        made.append(sum(one.num for one in asked))
        return propose(source, asked, *given)

    monkeypatch.setattr(predictor, "ask_all", counted)
    monkeypatch.setattr(device, "PREDICTIONS", {"cpu": {device.ONE: (1, 4, 4)}})
    for name, value in (("HAND", "gripper3"), ("OBJECT", "sphere"), ("ALL_AT_FIRST", RetryConfig(first=first))):
        monkeypatch.setattr(device, name, value)
    options = SimpleNamespace(settled=True, record=tmp_path / "rows.jsonl")
    ((_, _, _, *_, rate),) = device.predictions("cpu", 1, options)
    one, = _noted(options.record).values()
    assert one["candidates"] == sum(made[len(made) // 2:]) == {2: 8, 16: 16}[first]
    assert one["rate"] == pytest.approx(1e3 * one["candidates"] / one["milliseconds"])
    assert float(rate) == pytest.approx(one["rate"], abs=0.06)


def test_synthesis_is_of_strict_valid_grasps_of_built_in_training_objects(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, clock = [], iter(range(0, 99, 10))

    def shards(hand: Hand, wanted: list[Wanted], config: EngineConfig) -> list[tuple[None, Yield]]:
        made = []
        for one in wanted:
            asked.append((hand.name, one.obj.name, one.obj.split, config.protocol, config.confirm))
            made.append((None, Yield(candidates=100, valid=10 + len(asked), judged=5, judging_seconds=0.5)))
        return made

    monkeypatch.setattr(device, "valid_grasps_of_all", shards)
    monkeypatch.setattr(device, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    monkeypatch.setattr(device, "SHARDS", {"cpu": 3})
    monkeypatch.setattr(device, "SHARES", {"cpu": (1.0, 0.1)})
    device.shards("cpu", SimpleNamespace(record=tmp_path / "rows.jsonl"))
    assert {(hand, split, rules) for hand, _, split, rules, _ in asked} == {("allegro", "train", "strict")}
    names = [name for _, name, *_ in asked]
    assert names[:3] == names[3:]
    assert set(names) < set(resolve_objects(["builtin:train"]))
    assert [share for *_, share in asked] == [1.0] * 3 + [0.1] * 3
    found = _noted(tmp_path / "rows.jsonl")
    assert [(found[name]["rate"], found[name]["valid"], found[name]["judged"]) for name in (
        "shard, 1 confirmed", "shard, 0.1 confirmed")] == [(3.6, 36, 15), (4.5, 45, 15)]
    assert found["shard, 1 confirmed"]["judging"] == 0.15


@pytest.mark.parametrize("path", STORED, ids=lambda path: path.stem)
def test_stored_grasps_of_each_hand_are_as_many_as_the_table_wants(path: Path) -> None:
    grasps = GraspBatch.load(ROOT / path)
    found = list(device_trials.shares(grasps, 400))
    rows = torch.cat([rows for _, rows in found])
    assert len(rows) == len(rows.unique()) == 400
    assert {grasps.split[row] for row in rows.tolist()} == {"train"}
    assert [grasps.object[row] for row in rows.tolist()] == [name for name, own in found for _ in own]


def test_verdicts_of_few_grasps_of_an_object_are_the_device_s(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo in Warp's place says that they explode."""
    pytest.importorskip("mujoco_warp")

    def explode(state: State, missed: np.ndarray) -> None:
        state["qpos"][:] = np.nan

    steps, path = Steps(explode), tmp_path / "grasps.parquet"
    monkeypatch.setattr(warp_worlds, "_graphs", steps)
    stored = steady_grasps()[0]
    stored.replace(split=("train",) * len(stored)).save(path)
    options = SimpleNamespace(num=3, device="cuda", record=tmp_path / "rows.jsonl")
    ((_, grasps, held, other, *_),) = device_trials.agreement(path, "strict", options)
    assert steps.calls
    assert (grasps, held[:4], other[:3]) == (3, "66.7", "0.0")


@pytest.mark.assets
def test_what_agreement_needs_of_the_assets_goes_to_another_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, assets_folder: Path
) -> None:
    monkeypatch.chdir(ROOT)
    names = [name for name, _ in device_trials.shares(GraspBatch.load(STORED[0]), 100)]
    expected = [load_object(name) for name in names]
    device_trials.main(["--grasps", str(STORED[0]), "--num", "100", "--pack", str(tmp_path)])
    monkeypatch.setenv("DRO_GRASP_ASSETS", str(tmp_path))
    assert resolve_objects(["assets:train"]) == sorted(names)
    for one, own in zip(expected, map(load_object, names), strict=True):
        assert (one.sha256, one.split, len(one.parts)) == (own.sha256, own.split, len(own.parts))


def test_a_gpu_s_table_has_a_part_for_every_row_and_is_blank_where_nothing_was_noted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first part is done, the second is cut off, the third fails, and the fourth leaves half a line."""
    record, begun = tmp_path / "rows" / "gpu.jsonl", []

    def run(command: list[str], timeout: float, **_: object) -> SimpleNamespace:
        begun.append(command)
        assert command[-2:] == ["--record", str(record)]
        assert command[command.index("--device") + 1] == "cuda"
        if len(begun) == 1:
            for name in gpu_table.parts("cuda")[0][0]:
                note(record, name, device="cuda", rate=600.0, milliseconds=151.0, candidates=1024)
        elif len(begun) == 2:
            note(record, "closings", device="cuda", rate=4999.0, worlds=4096)
            raise subprocess.TimeoutExpired(command, timeout)
        elif len(begun) == 4:
            with record.open("a") as file:
                file.write('{"name": "shard, 1 confirmed", "devi')
        return SimpleNamespace(returncode=int(len(begun) == 3))

    monkeypatch.setattr(gpu_table, "subprocess", SimpleNamespace(run=run, **{
        name: getattr(subprocess, name) for name in ("DEVNULL", "TimeoutExpired")}))
    monkeypatch.setattr(gpu_table, "require_device", lambda device: None)
    monkeypatch.setattr(extras, "find_spec", lambda name: object())
    monkeypatch.setattr(gpu_table, "state", lambda: "this code")
    assert gpu_table.main(["--record", str(record)]) == 1
    names = [name for names, _ in gpu_table.parts("cuda") for name in names]
    assert sorted(names) == sorted({row.name for row in gpu_table.ROWS})
    assert len(begun) == len(gpu_table.parts("cuda"))
    shown, told = capsys.readouterr()
    assert told.splitlines()[-1] == f"not measured: {'; '.join(['whole strict trials', *names[5:]])}"
    table = gpu_table.lines(gpu_table.noted(record, "cuda"))
    assert [(row[1], row[4]) for row in table[:5]] == [
        (600.0, "yes"), (600.0, "yes"), (151.0, "no"), (4999.0, "no"), ("blank", "")]
    assert all(row[1] == "blank" for row in table[5:])
    assert shown.count("blank") == len(table) - 4 + 1
    for hand, grasps in (("allegro", 400), ("barrett", 100)):
        note(record, f"agreement, {hand}, strict", device="cuda", same=grasps - 1, grasps=grasps, asked=400)
    note(record, "training, multi", device="cpu", rate=1.0)
    begun.clear()
    gpu_table.main(["--record", str(record), "--minutes", "1"])
    assert {command[2].rpartition(".")[2] for command in begun} == {"device_trials", "training", "device"}
    assert not any("prediction" in command for command in begun)
    assert not any("data/grasps/allegro.parquet" in command for command in begun)
    assert any("data/grasps/barrett.parquet" in command for command in begun)
    begun.clear()
    monkeypatch.setattr(gpu_table, "state", lambda: "other code")
    gpu_table.main(["--record", str(record), "--show"])
    assert gpu_table.noted(record, "cuda")
    gpu_table.main(["--record", str(record), "--minutes", "1"])
    assert len(begun) == len(gpu_table.parts("cuda"))


def test_a_whole_table_of_a_gpu_lacks_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(gpu_table, "state", lambda: "this code")
    for names, _ in gpu_table.parts("cuda"):
        for name in names:
            note(tmp_path / "rows.jsonl", name, device="cuda", rate=1.0, milliseconds=1.0, judging=0.1, same=1, grasps=1)
    assert gpu_table.main(["--record", str(tmp_path / "rows.jsonl"), "--show"]) == 0
    assert not capsys.readouterr().err


def test_rows_of_a_gpu_are_of_code_weights_and_card(monkeypatch: pytest.MonkeyPatch) -> None:
    hashes = {"src/dro_grasp": "1", "lab/benchmarks": "2"}
    monkeypatch.setattr(gpu_table, "code_hash", hashes.__getitem__)
    found = [gpu_table.state()]
    for name, other in (("code_hash", lambda part: "1"), ("weights_hashes", lambda: {"a": "b"}),
                        ("machine", lambda: {"cuda": "another"})):
        monkeypatch.setattr(gpu_table, name, other)
        found.append(gpu_table.state())
    assert len(set(found)) == 4


def test_a_table_is_rehearsed_with_warp_on_the_processor(tmp_path: Path) -> None:
    for names, command in gpu_table.parts("warp"):
        used = command[command.index("--device") + 1]
        assert used == ("warp" if command[0] == "device_trials" else "cpu")
        for name in names:
            note(tmp_path / "rows.jsonl", name, device=used)
    assert set(gpu_table.noted(tmp_path / "rows.jsonl", "warp")) == {
        name for names, _ in gpu_table.parts("warp") for name in names}
