"""Sources by name, and the door for sources of others."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from dro_grasp.cli.main import main
from dro_grasp.compare.methods import Method, MethodOptions, make_method
from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import TABLE
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.synthesis import SynthesisConfig
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.network import NetworkSource
from dro_grasp.predict.sources.optimiser import DescentSource, OptimiserSource
from dro_grasp.predict.sources.own import FileSource, OwnSource
from dro_grasp.predict.sources.registry import SOURCES, make_source, register_source, source_names
from dro_grasp.predict.sources.source import Candidates, Progress, Source, ask
from dro_grasp.simulation.trial import simulate
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.tiny_bundle import made_up_grasps
from tests.helpers.toy_hand import toy_hand

MINE = """
import torch
from dro_grasp import GraspBatch

class Mine:
    def predict(self, hand, obj, num, seed):
        T = torch.eye(4).repeat(num, 1, 1)
        return GraspBatch.create(hand, obj, T, hand.canonical_joints(0.5).expand(num, -1).contiguous(), seed=seed)

class Mute:
    pass

class Needy:
    def __init__(self, temperature):
        self.temperature = temperature

NUMBER = 3
"""


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "somebodys_module.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def registering() -> Iterator[Callable[..., None]]:
    """`register_source`, whose names are gone after the test."""
    before = dict(SOURCES)
    yield register_source
    SOURCES.clear()
    SOURCES.update(before)


def test_every_name_makes_a_source_that_proposes_the_same_for_the_same_seed(bundle, weights: str) -> None:
    problem, options = GraspProblem(toy_hand(), load_object("sphere")), MethodOptions(weights, bundle=bundle)
    for name in ("network", "auto", "start", "mean-grasp", "mean-grasp-chosen"):
        method = make_method(name, options)
        assert method.name == name
        assert method.knows(problem.hand)
        first, again, other = (method.propose(problem, 3, seed) for seed in (5, 5, 6))
        assert (len(first), first.points.shape[0], len(first.origin)) == (3, 3, 3)
        assert torch.equal(again.grasps.T_object_wrist, first.grasps.T_object_wrist)
        assert not torch.equal(other.grasps.T_object_wrist, first.grasps.T_object_wrist)
        assert all(seconds >= 0 for seconds in first.seconds.values())
    kinds = {"network": NetworkSource, "auto": NetworkSource, "optimiser": OptimiserSource, "dfc": DescentSource}
    predictor = GraspPredictor(weights)
    assert {name: type(predictor.source(name)) for name in kinds} == kinds
    assert set(source_names()) == {"network", "optimiser", "dfc", "start"}


def test_weights_of_a_method_stand_behind_its_name(weights: str) -> None:
    method = make_method(f"network@{weights}")
    assert method.name == f"network@{weights}"
    assert method.predictor.weights_name == "untrained"
    assert len(method.propose(GraspProblem(loaded_hand("gripper3"), load_object("sphere")), 2, 0)) == 2
    assert make_method(f"auto@{weights}").asks == "auto"
    with pytest.raises(OptionError, match="there is no source 'dfc@"):
        make_method(f"dfc@{weights}")


def test_a_descent_keeps_whatever_comes_out() -> None:
    """As many grasps as descents: the n of a larger run are those of a smaller one beside others, not the best of them."""
    problem = GraspProblem(toy_hand(), load_object("sphere"))
    source = DescentSource(SynthesisConfig(steps=3, batch_size=2))
    few, more = (source.propose(problem, n, 1).T_object_wrist for n in (2, 4))
    assert all(float((more - T).abs().amax((1, 2)).min()) < 1e-6 for T in few)


def test_a_class_of_yours_stands_in_the_table(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["benchmark", "--method", "start", "somebodys_module:Mine", "--hands", "gripper3", "--objects", "can", "--num",
               "2", "--stages", "raw", "--protocols", "dro", "--json"]
    assert main(command) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["grasps"], row["num"]) for row in rows] == [("start", 2), ("somebodys_module:Mine", 2)]
    hand, obj = loaded_hand("gripper3"), load_object("can")
    alone = simulate(hand, obj, make_source("somebodys_module:Mine").propose(GraspProblem(hand, obj), 2, 0), "dro").success
    assert rows[1]["success"]["dro/1"][0] == float(alone.float().mean())


@pytest.mark.parametrize(("name", "told"), [
    ("sorcery", "there is no source 'sorcery'; choose auto, network"), ("no_such_module:Mine", "cannot be imported"),
    ("somebodys_module:Yours", "cannot be imported"), ("somebodys_module:Mute", "has no predict"),
    ("mean-grasp", "bundle=PATH"),
    ("somebodys_module:Needy", "cannot be made without arguments .*'temperature'.*give a class or function that takes none"),
    ("somebodys_module:NUMBER", "cannot be made without arguments .*not callable"),
    ("network", r"GraspPredictor\(\).source\('network'\) makes it"),
])
def test_what_is_no_source_is_explained(mine: Path, name: str, told: str) -> None:
    with pytest.raises(OptionError, match=told):
        make_source(name)


@pytest.mark.parametrize(("code", "told"), [
    ("class Mine:\n  def", "SyntaxError"), ("open('missing.pt')", "FileNotFoundError.*missing.pt"),
    ("1 / 0", "ZeroDivisionError")])
def test_a_module_that_fails_when_it_is_imported_is_explained(
    code: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_module.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(OptionError, match=rf"'broken_module:Mine' cannot be imported \({told}"):
        make_source("broken_module:Mine")


def test_what_a_class_returns_is_checked() -> None:
    class Returns:
        def __init__(self, grasps: object) -> None:
            self.grasps = grasps

        def predict(self, *_: object) -> object:
            return self.grasps

    class Proposes(Returns):
        def propose(self, problem: GraspProblem, num: int, seed: int) -> object:
            return Candidates.of(problem, self.grasps, 50)  # type: ignore[arg-type]

    problem = GraspProblem(toy_hand(), load_object("sphere"))
    right = made_up_grasps(toy_hand(), "sphere", 3)
    for maker in (Returns, Proposes):
        assert len(OwnSource("mine", maker(right)).propose(problem, 2, 0)) == 2
    assert ask(OwnSource("mine", Proposes(right)), problem, 2, 0).points.shape[1] == 50
    for wrong, told in ((None, "a NoneType"), (made_up_grasps(toy_hand(), "ball"), "grasps of ball")):
        with pytest.raises(OptionError, match=told):
            OwnSource("mine", Returns(wrong)).propose(problem, 2, 0)
    with pytest.raises(GraspFileError):
        OwnSource("mine", Returns(right)).propose(GraspProblem(loaded_hand("gripper3"), load_object("sphere")), 2, 0)


def test_a_class_that_needs_arguments_is_no_bug_of_the_program(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["generate", "--hand", "gripper3", "--object", "sphere", "--source", "somebodys_module:Needy"]) == 2
    said = capsys.readouterr().err
    assert "source 'somebodys_module:Needy' cannot be made without arguments" in said
    assert "bug" not in said


def test_a_source_of_yours_may_descend(weights: str) -> None:
    """Predictors turn gradients off, and what comes out carries no graph."""
    class Descends:
        def predict(self, hand: Hand, obj: ObjectModel, num: int, seed: int) -> GraspBatch:
            x = torch.zeros(num, requires_grad=True)
            x = x - 0.1 * torch.autograd.grad(((x - 1) ** 2).sum(), x, create_graph=True)[0]
            T = torch.eye(4).repeat(num, 1, 1)
            T[:, 2, 3] = x
            return GraspBatch.create(hand, obj, T, hand.canonical_joints(0.5).expand(num, -1).contiguous(), energy=x)

    class Proposes(Descends):
        def propose(self, problem: GraspProblem, num: int, seed: int) -> Candidates:
            return Candidates.of(problem, self.predict(problem.hand, problem.obj, num, seed), 20)

    problem = GraspProblem(toy_hand(), load_object("sphere"))
    for kind in (Descends, Proposes):
        method = Method(OwnSource("mine", kind()), GraspPredictor(weights))
        found = method.propose(problem, 2, 0)
        assert found.grasps.T_object_wrist[:, 2, 3].tolist() == pytest.approx([0.2, 0.2])
        assert not any(column.requires_grad for column in (found.grasps.T_object_wrist, found.grasps.energy, found.points))


def test_a_source_that_fails_is_named_with_its_error() -> None:
    class Broken:
        def predict(self, *_: object) -> object:
            raise ValueError("my own bug")

    problem = GraspProblem(loaded_hand("gripper3"), load_object("sphere"))
    with pytest.raises(OptionError, match=r"source 'mine' failed: ValueError: my own bug"):
        OwnSource("mine", Broken()).propose(problem, 1, 0)


def test_a_source_of_another_hand_is_told_by_whatever_way_it_comes() -> None:
    class Stubborn(Source):
        name = "stubborn"

        def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> GraspBatch:
            return made_up_grasps(toy_hand(), "sphere", num)

    with pytest.raises(GraspFileError, match="these grasps are for hand 'toy'"):
        ask(Stubborn(), GraspProblem(loaded_hand("gripper3"), load_object("sphere")), 2, 0)


def test_stored_grasps_are_a_source_of_their_hand_and_objects(tmp_path: Path) -> None:
    hand, obj = toy_hand(), load_object("sphere")
    stored = make_source("start").propose(GraspProblem(hand, obj), 5, 0)
    assert isinstance(stored, GraspBatch)
    stored = stored.replace(score=torch.arange(5.0))
    stored.save(tmp_path / "theirs.parquet")
    source = make_source(str(tmp_path / "theirs.parquet"))
    assert isinstance(source, FileSource)
    assert source.name == "theirs"
    assert source.knows(hand)
    assert not source.knows(loaded_hand("gripper3"))
    drawn = source.propose(GraspProblem(hand, obj), 3, 0)
    assert len(drawn) == 3
    assert bool(drawn.score.isnan().all())
    assert all(float((stored.T_object_wrist - T).abs().amax((1, 2)).min()) < 1e-6 for T in drawn.T_object_wrist)
    assert len(source.propose(GraspProblem(hand, obj), 9, 0)) == 5
    with pytest.raises(GraspFileError, match="no grasp of 'can', but of sphere"):
        source.propose(GraspProblem(hand, load_object("can")), 1, 0)


def test_a_stored_answer_of_nothing_is_an_answer(tmp_path: Path) -> None:
    hand, obj = toy_hand(), load_object("sphere")
    stored = make_source("start").propose(GraspProblem(hand, obj), 5, 0)
    assert isinstance(stored, GraspBatch)
    can = load_object("can")
    stored.replace(asked_of={("sphere", obj.sha256): 5, ("can", can.sha256): 3}).save(tmp_path / "theirs.parquet")
    source = make_source(str(tmp_path / "theirs.parquet"))
    assert len(source.propose(GraspProblem(hand, can), 3, 0)) == 0
    assert source.asked(can, 8) == 3


@pytest.mark.parametrize("name", [
    "start", "auto", "network", "optimiser", "mean-grasp", "", "my:source", "a@b", "a.parquet", "a/b"])
def test_a_name_that_is_taken_or_means_something_else_is_refused(registering: Callable[..., None], name: str) -> None:
    with pytest.raises(OptionError, match=r"choose another name|is no name of a source"):
        registering(name, object)
    assert name not in SOURCES or name == "start"


def test_a_source_without_a_name_of_its_own_goes_by_the_one_that_it_was_given(registering: Callable[..., None]) -> None:
    class Nameless(Source):
        def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> GraspBatch:
            return make_source("start").propose(problem, num, seed)  # type: ignore[return-value]

    registering("mine", Nameless)
    assert source_names()[-1] == "mine"
    made = ask(make_source("mine"), GraspProblem(toy_hand(), load_object("sphere")), 2, 0)
    assert made.origin == ("mine", "mine")
    assert list(made.seconds) == ["mine"]


def test_grasps_that_were_made_on_a_table_have_none_where_there_is_none() -> None:
    hand, obj = loaded_hand("gripper3"), load_object("can")
    on = GraspProblem(hand, obj, constraints=Constraints(table=-0.05))
    there = on.on_table(made_up_grasps(hand, "can", 2))
    assert TABLE in there.extra
    assert TABLE not in GraspProblem(hand, obj).on_table(there).extra
