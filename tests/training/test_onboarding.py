"""A hand from its file to weights and a report, taken up where it stopped."""

from __future__ import annotations

import html
import json
import re
import shlex
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dro_grasp import extras
from dro_grasp.cli.main import main
from dro_grasp.errors import BundleError, OptionError, OutputError
from dro_grasp.hands.library import BUILTIN_FOLDER
from dro_grasp.network.checkpoints import describe_weights
from dro_grasp.predict.config import PredictorConfig, RescueConfig
from dro_grasp.predict.finish import FinishConfig
from dro_grasp.training import loop, onboarding
from dro_grasp.training.config import TrainConfig
from dro_grasp.training.data.engine.shards import sole_run
from dro_grasp.training.data.engine.worker import EngineConfig
from dro_grasp.training.onboarding import Onboarded, OnboardingConfig, onboard, write_report
from dro_grasp.training.runs import recalibrate
from tests.helpers.weights import untrained_weights


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("onboarding")
    shutil.copy(BUILTIN_FOLDER / "gripper3.urdf", folder / "mine.urdf")
    untrained_weights(folder)
    return folder


def small(home: Path, **more: object) -> OnboardingConfig:
    """Small shards, and few grasps in the report."""
    given = OnboardingConfig(
        0.01, ("sphere",), ("can",), 2, str(home / "untrained.safetensors"), 1, "network", grasps_drawn=3,
        engine=EngineConfig(candidates=32, min_candidates=32))
    return replace(given, **more)


@pytest.fixture(scope="module", autouse=True)
def few_batches() -> Iterator[None]:
    """The statistics of BatchNorm come from two batches; more take most of so short a training."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "recalibrate", lambda model, forward, _: recalibrate(model, forward, 2))
        yield


@pytest.fixture(scope="module")
def made(home: Path) -> Onboarded:
    return onboard(str(home / "mine.urdf"), home / "out", small(home))


def command(home: Path, *more: str, hand: str = "mine.urdf") -> list[str]:
    return ["onboard", str(home / hand), "--output", str(home / "out"), "--objects", "sphere", "--held-out", "can",
            "--num", "2", "--minutes", "0.01", "--workers", "1", "--weights", str(home / "untrained.safetensors"),
            "--source", "network", *more]


def test_a_file_becomes_weights_and_a_report(home: Path, made: Onboarded) -> None:
    grasps = made.steps["training"]["grasps"]
    assert set(made.steps) == {"check", "before", "data", "training", "after"}
    assert grasps > 0
    assert describe_weights(home / "out" / onboarding.WEIGHTS)["about"]["data"]["hands"] == {"mine": grasps}
    page = write_report(made).read_text()
    assert page.count("data:image/png;base64,") == 2, "the hand, and grasps of the one held-out object"
    assert "http" not in page.replace("http-equiv", ""), "nothing is fetched"
    assert f"{made.rate('after', 'refined', 'carry/1'):.0%} after" in page
    for step in ("before", "after"):
        returned = f"{made.rate(step, 'returned', 'carry/1'):.0%} {step}"
        assert f"{returned} ({made.optimised(step):.0%} of them made by the optimiser)" in page
    assert " of 3 made by the optimiser" in page
    for row in json.loads((home / "out" / onboarding.STATE).read_text())["steps"]["after"]["rows"]:
        share, everyone = row["fingers"]["carry/1"]
        assert f"{100 * share:.0f} ({100 * everyone:.0f})" in page
    assert f"--weights {made.weights}" in page


def test_a_rerun_does_nothing_again(home: Path, made: Onboarded, capsys: pytest.CaptureFixture[str]) -> None:
    before = {name: (home / "out" / name).read_bytes() for name in (onboarding.STATE, onboarding.WEIGHTS)}
    assert main(command(home, "--json")) == 0
    told, said = capsys.readouterr()
    told = json.loads(told.splitlines()[-1])
    assert said.count("finished before") == 5
    assert {name: (home / "out" / name).read_bytes() for name in before} == before, "the time of each step among it"
    assert told["grasps"] == made.steps["training"]["grasps"]
    assert told["fine_tuned"] == str(home / "out" / onboarding.WEIGHTS)
    assert told["weights"] == (told["fine_tuned"] if told["gained"] else str(home / "untrained.safetensors"))
    assert told["without_grasps"] == []
    assert told["report"] == str(home / "out" / "report.html")
    for step in ("before", "after"):
        assert told[step]["returned"]["carry/1"] == made.rate(step, "returned", "carry/1")
        assert told["optimised"][step] == made.optimised(step)


def test_a_report_says_of_which_object_no_grasp_was_found(made: Onboarded, tmp_path: Path) -> None:
    """A confidence that no grasp has stands for an object that the hand cannot hold."""
    none = PredictorConfig(finish=FinishConfig(least_confidence=1 - 1e-9))
    done = replace(made, folder=tmp_path, config=replace(made.config, predictor=none))
    shutil.copy(made.folder / onboarding.PICTURE, tmp_path)
    page = write_report(done).read_text()
    assert re.search("can: none was found: .*probability below", page)
    assert "Next steps" in page


def test_the_next_steps_are_commands_for_shells(tmp_path: Path) -> None:
    folder, hand = tmp_path / "my hand", "it's $mine; hand.urdf"
    done = replace(onboarded(folder, 60, 100), hand=hand)
    page = html.unescape(onboarding._commands(done)).removeprefix("<pre>").removesuffix("</pre>")
    words = [shlex.split(line) for line in page.splitlines()]
    assert words[0][2:8] == ["--hand", hand, "--object", "my_mesh.stl", "--weights", str(folder / onboarding.WEIGHTS)]
    assert words[-1] == ["dro-grasp", "dataset", "report", str(folder / onboarding.DATA), "--output", "data.html"]


@pytest.mark.usefixtures("made")
def test_what_generate_returns_is_of_the_source_that_is_asked_for(home: Path) -> None:
    """Data and training know no source, so both are taken over from the run with another one."""
    shutil.copytree(home / "out", home / "optimised")
    state = json.loads((home / "out" / onboarding.STATE).read_text())
    state["asked"]["source"] = "optimiser"
    state["steps"] = {name: state["steps"][name] for name in ("check", "data", "training")}
    (home / "optimised" / onboarding.STATE).write_text(json.dumps(state))
    done = onboard(str(home / "mine.urdf"), home / "optimised", small(home, source="optimiser"))
    assert [done.optimised(step) for step in ("before", "after")] == [1.0, 1.0]
    page = write_report(done).read_text()
    assert "3 of 3 made by the optimiser" in page
    assert "--source optimiser --output grasps.parquet" in page


@pytest.mark.usefixtures("made")
def test_a_run_that_stopped_goes_on(home: Path) -> None:
    state = json.loads((home / "out" / onboarding.STATE).read_text())
    kept = {name: state["steps"][name] for name in ("check", "before", "data")}
    (home / "out" / onboarding.STATE).write_text(json.dumps(state | {"steps": kept}))
    told: list[str] = []
    again = onboard(str(home / "mine.urdf"), home / "out", small(home), told.append)
    assert sum("finished before" in line for line in told) == 3
    assert {name: again.steps[name] for name in kept} == kept


def onboarded(folder: Path, before: int, after: int, asked: int = 200, **steps_made: dict) -> Onboarded:
    rows = [[{"stage": stage, "asked": asked, "held": {"carry/1": held}, "success": {"carry/1": (held / asked, 0, 1)}}
             for stage in ("raw", "refined")] for held in (before, after)]
    return Onboarded("mine", folder, {"before": {"rows": rows[0]}, "after": {"rows": rows[1]}, **steps_made},
                           OnboardingConfig(weights="multi"))


@pytest.mark.parametrize("after", [40, 60, 61, 90])
def test_what_gained_nothing_says_so_and_keeps_the_weights_from_before(home: Path, after: int) -> None:
    data = {"counts": {"can": 9, "box": 0}, "failures": {"box": "no contact", "torus": "too thin", "can": "too little time"}}
    done = onboarded(home, 60, after, data=data)
    told = " ".join(done.verdict())
    assert done.without_grasps == ["box", "torus"]
    assert "No training grasps of box, torus" in told
    assert done.gained == (after == 90)
    assert done.weights == (str(home / "weights.safetensors") if done.gained else "multi")
    said = f"gained nothing beyond chance: 60 of 200 of the refined grasps hold under carry/1 before, {after} of 200 after"
    assert (said in told) != done.gained


@pytest.mark.parametrize(("asked", "rate"), [(40, 0.5), (200, 0.3), (200, 0.6), (200, 0.9), (1000, 0.5)])
def test_weights_that_are_as_good_are_seldom_taken_for_better(home: Path, asked: int, rate: float) -> None:
    generator = np.random.default_rng(0)
    pairs = Counter(map(tuple, generator.binomial(asked, rate, (2, 4000)).T.tolist()))
    gained = sum(count for (before, after), count in pairs.items() if onboarded(home, before, after, asked).gained)
    assert pairs.total() == 4000
    assert gained / 4000 <= 0.05


def test_weights_that_are_clearly_better_are_taken(home: Path) -> None:
    generator = np.random.default_rng(0)
    before, after = (generator.binomial(200, rate, 1000).tolist() for rate in (0.5, 0.7))
    assert sum(onboarded(home, b, a).gained for b, a in zip(before, after, strict=True)) >= 900


@pytest.mark.usefixtures("made")
def test_the_folder_of_another_hand_is_refused(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copy(BUILTIN_FOLDER / "barrett.urdf", home / "other.urdf")
    assert main(command(home, hand="other.urdf")) == 2
    assert "belongs to hand 'mine'" in capsys.readouterr().err


@pytest.mark.usefixtures("made")
@pytest.mark.parametrize(("more", "word"), [
    (["--seed", "7"], "with seed"),
    (["--source", "auto"], "with source network, auto was asked for")])
def test_a_folder_that_was_begun_otherwise_is_refused(
    home: Path, more: list[str], word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its finished steps would be given for those that were asked for."""
    assert main([*command(home), *more]) == 2
    assert word in capsys.readouterr().err


@pytest.mark.usefixtures("made")
def test_a_folder_that_was_begun_with_another_configuration_is_refused(home: Path) -> None:
    for more, word in (({"engine": EngineConfig(max_shift=0.02)}, "engine.max_shift 0.03, 0.02 was asked for"),
                       ({"predictor": PredictorConfig(rescue=RescueConfig(per_grasp=2))}, "predictor.rescue.per_grasp 8, 2"),
                       ({"training": TrainConfig()}, "training.schedule.steps 1000000, 10000")):
        with pytest.raises(OptionError, match=f"was begun with {word}"):
            onboard(str(home / "mine.urdf"), home / "out", small(home, **more))


@pytest.mark.usefixtures("made")
def test_a_folder_that_was_begun_with_other_weights_is_refused(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command(home), "--weights", str(untrained_weights(tmp_path))]) == 2
    assert "was begun with weights" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "word"), [(["--objects", "can"], "can would be trained on"), (["--minutes", "0"], "minutes is 0.0")])
def test_what_makes_no_sense_is_refused(
    home: Path, more: list[str], word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command(home), *more]) == 2
    assert word in capsys.readouterr().err


def test_a_hand_that_grasps_nothing_is_told(home: Path) -> None:
    nothing = EngineConfig(candidates=32, max_penetration=-1.0, max_barren_rounds=1)
    with pytest.raises(BundleError, match=r"no grasp of .* look at .*: 0 grasps, none in .*: hand too deep in the object"):
        onboard(str(home / "mine.urdf"), home / "empty", small(home, engine=nothing))


@pytest.mark.parametrize(
    ("option", "value", "word"),
    [("--minutes", "nan", "error: minutes is nan; give a positive number, for example --minutes 30\n"),
     ("--minutes", "inf", "error: minutes is inf; "), ("--num", "0", "error: num is 0; give at least 1 (--num)\n"),
     ("--workers", "0", "error: workers is 0; "), ("--held-out", "cann", "no object is called 'cann'"),
     ("--held-out", "nowhere.stl", "nowhere.stl"), ("--objects", "spher", "no object is called 'spher'"),
     ("--weights", "nowhere", "no weights at 'nowhere'"), ("hand", "nothand.urdf", "nothand.urdf"),
     ("hand", "missing.urdf", "missing.urdf")],
)
def test_what_is_refused_leaves_no_folder(
    home: Path, option: str, value: str, word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (home / "nothand.urdf").write_text("<robot name='a'><link name='b'/></robot>")
    more = ["--output", str(home / "new")]
    line = command(home, *more, hand=value) if option == "hand" else command(home, *more, option, value)
    assert main(line) == 2
    assert word in capsys.readouterr().err
    assert not (home / "new").exists()


@pytest.mark.parametrize(("more", "word"), [
    ({"grasps_drawn": 0}, "grasps_drawn is 0"), ({"most_grasps": 0}, "most_grasps is 0"),
    ({"data_share": 0.7}, r"are \(0.7, 0.4\)"), ({"training_share": 0.0}, r"are \(0.45, 0.0\)")])
def test_fields_out_of_range_are_refused(more: dict[str, float], word: str) -> None:
    with pytest.raises(OptionError, match=word):
        OnboardingConfig(**more)


def test_a_device_without_the_extra_for_trials_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onboarding, "require_device", lambda name: None)
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    with pytest.raises(OptionError, match=r"warp, mujoco_warp.*dro-grasp\[gpu\]"):
        OnboardingConfig(device="cuda")


def test_shards_on_a_device_are_as_large_as_those_of_synthesize(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[EngineConfig]()

    def synthesized(*given: object) -> None:
        asked.extend(one for one in given if isinstance(one, EngineConfig))
        raise InterruptedError

    monkeypatch.setattr(onboarding, "require_device", lambda device: None)
    monkeypatch.setattr(extras, "find_spec", lambda name: object())
    monkeypatch.setattr(onboarding, "synthesize_dataset", synthesized)
    for device in ("cpu", "cuda"):
        begun = onboarding._Onboarding("gripper3", tmp_path, small(home, device=device), ["can"], [], str)
        with pytest.raises(InterruptedError):
            begun._data()
    assert [one.synthesis.device for one in asked] == ["cpu", "cuda"]
    assert asked[0].candidates == 32
    assert asked[1] == asked[1].suited() != asked[0].suited()


def test_objects_of_one_name_are_refused_before_the_work(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [home / folder / "cup.stl" for folder in ("a", "b")]
    for file in files:
        file.parent.mkdir()
        file.touch()
    assert main([*command(home), "--output", str(home / "new"), "--objects", *map(str, files)]) == 2
    assert f"objects '{files[0]}' and '{files[1]}' are both called 'cup'" in capsys.readouterr().err
    assert not (home / "new").exists()


def test_a_damaged_state_is_set_aside_and_a_second_run_kept_out(
    home: Path, tmp_path: Path
) -> None:
    told: list[str] = []
    for number, content in enumerate(("{", "[]", '{"hand": "mine", "sha256": "x", "steps": 5}', '{"hand": "mine"}'), 1):
        (tmp_path / onboarding.STATE).write_text(content)
        assert onboarding._Onboarding(str(home / "mine.urdf"), tmp_path, small(home), [], [], told.append).steps == {}
        assert (tmp_path / f"{onboarding.STATE}.damaged{'' if number == 1 else f'.{number}'}").read_text() == content
    assert len(told) == 4
    assert all("is damaged" in line and "made again" in line for line in told)
    with sole_run(tmp_path), pytest.raises(OutputError, match="another run is filling"):
        onboard(str(home / "mine.urdf"), tmp_path)
