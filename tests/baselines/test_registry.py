"""Methods by name, and the door for methods of others."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
import torch

from dro_grasp.baselines import ours
from dro_grasp.baselines.foreign import FileMethod, ForeignMethod
from dro_grasp.baselines.method import Method
from dro_grasp.baselines.ours import DescentMethod
from dro_grasp.baselines.registry import METHODS, MethodOptions, make_method
from dro_grasp.cli.main import main
from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimization.synthesis import SynthesisConfig
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.simulation.trial import simulate
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.tiny_bundle import made_up_grasps
from tests.helpers.toy_hand import toy_hand
from tests.helpers.weights import untrained_weights

MINE = """
import torch
from dro_grasp import GraspBatch

class Mine:
    def predict(self, hand, obj, num, seed):
        T = torch.eye(4).repeat(num, 1, 1)
        return GraspBatch.create(hand, obj, T, hand.canonical_joints(0.5).expand(num, -1).contiguous(), seed=seed)

class Mute:
    pass
"""


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "somebodys_module.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_name_makes_a_method_that_predicts_as_the_predictor_does(bundle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ours, "DESCENT_STEPS", 4)
    hand, obj = toy_hand(), load_object("sphere")
    for name in sorted(set(METHODS) - {"dro", "synthesise"}):
        method = make_method(name, MethodOptions(bundle=bundle))
        assert method.name == name
        assert method.knows(hand)
        grasps = method.predict(hand, obj, 3, seed=5)
        assert len(grasps) == 3
        assert grasps.hand == hand.name
        again = method.predict(hand, obj, 3, seed=5)
        assert torch.equal(again.T_object_wrist, grasps.T_object_wrist)
        assert not torch.equal(method.predict(hand, obj, 3, seed=6).T_object_wrist, grasps.T_object_wrist)


def test_weights_of_a_method_stand_behind_its_name(tmp_path: Path) -> None:
    path = untrained_weights(tmp_path)
    method = make_method(f"dro@{path}")
    assert method.name == f"dro@{path}"
    assert len(method.make(GraspProblem(loaded_hand("gripper3"), load_object("sphere")), 2, 0)) == 2
    with pytest.raises(OptionError, match="dro@PATH"):
        make_method(f"dfc@{path}")


def test_a_descent_keeps_whatever_comes_out() -> None:
    """As many grasps as descents: the n of a larger run are those of a smaller one beside others, not the best of them."""
    problem = GraspProblem(toy_hand(), load_object("sphere"))
    method = DescentMethod(SynthesisConfig(steps=3, batch_size=2))
    few, more = (method.make(problem, n, 1).T_object_wrist for n in (2, 4))
    assert all(float((more - T).abs().amax((1, 2)).min()) < 1e-6 for T in few)


def test_a_class_of_yours_stands_in_the_table(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["benchmark", "--method", "start", "somebodys_module:Mine", "--hands", "gripper3", "--objects", "can", "--num",
               "2", "--stages", "raw", "--protocols", "dro", "--json"]
    assert main(command) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["grasps"], row["num"]) for row in rows] == [("start", 2), ("somebodys_module:Mine", 2)]
    hand, obj = loaded_hand("gripper3"), load_object("can")
    alone = simulate(hand, obj, make_method("somebodys_module:Mine").predict(hand, obj, 2), "dro").success
    assert rows[1]["success"]["dro/1"][0] == float(alone.float().mean())


@pytest.mark.parametrize(("name", "told"), [
    ("sorcery", "there is no method 'sorcery'"), ("no_such_module:Mine", "cannot be imported"),
    ("somebodys_module:Yours", "cannot be imported"), ("somebodys_module:Mute", "has no predict"), ("mean-grasp", "--bundle"),
    ("gendexgrasp", "name it as lab.methods.gendexgrasp:GenDexGrasp"), ("manifm@mine.safetensors", "lab.methods.manifm:"),
])
def test_what_is_no_method_is_explained(mine: Path, name: str, told: str) -> None:
    with pytest.raises(OptionError, match=told):
        make_method(name)


def test_what_a_class_returns_is_checked() -> None:
    class Returns:
        def __init__(self, grasps: object) -> None:
            self.grasps = grasps

        def predict(self, *_: object) -> object:
            return self.grasps

    problem = GraspProblem(toy_hand(), load_object("sphere"))
    right = made_up_grasps(toy_hand(), "sphere", 3)
    assert len(ForeignMethod("mine", Returns(right)).make(problem, 2, 0)) == 2
    for wrong, told in ((None, "a NoneType"), (made_up_grasps(toy_hand(), "ball"), "grasps of ball")):
        with pytest.raises(OptionError, match=told):
            ForeignMethod("mine", Returns(wrong)).make(problem, 2, 0)
    with pytest.raises(GraspFileError):
        ForeignMethod("mine", Returns(right)).make(GraspProblem(loaded_hand("gripper3"), load_object("sphere")), 2, 0)


def test_a_method_that_fails_is_named_with_its_error() -> None:
    class Broken:
        def predict(self, *_: object) -> object:
            raise ValueError("my own bug")

    problem = GraspProblem(loaded_hand("gripper3"), load_object("sphere"))
    with pytest.raises(OptionError, match=r"method 'mine' failed: ValueError: my own bug"):
        ForeignMethod("mine", Broken()).make(problem, 1, 0)


def test_stored_grasps_are_a_method_of_their_hand_and_objects(tmp_path: Path) -> None:
    hand, obj = toy_hand(), load_object("sphere")
    stored = make_method("start").predict(hand, obj, 5).replace(score=torch.arange(5.0))
    stored.save(tmp_path / "theirs.parquet")
    method = make_method(str(tmp_path / "theirs.parquet"))
    assert isinstance(method, FileMethod)
    assert method.name == "theirs"
    assert method.knows(hand)
    assert not method.knows(loaded_hand("gripper3"))
    drawn = method.make(GraspProblem(hand, obj), 3, 0)
    assert len(drawn) == 3
    assert bool(drawn.score.isnan().all())
    assert all(float((stored.T_object_wrist - T).abs().amax((1, 2)).min()) < 1e-6 for T in drawn.T_object_wrist)
    assert len(method.make(GraspProblem(hand, obj), 9, 0)) == 5
    with pytest.raises(GraspFileError, match="no grasp of 'can', but of sphere"):
        method.make(GraspProblem(hand, load_object("can")), 1, 0)


def test_a_method_returns_what_it_makes_unless_it_chooses() -> None:
    class Counts(Method):
        name = "counts"

        def make(self, problem: GraspProblem, num: int, seed: int):
            return made_up_grasps(problem.hand, problem.obj.name, num, seed)

    made = Counts().best(GraspProblem(toy_hand(), load_object("sphere")), 4, 2)
    assert (len(made.grasps), made.candidates) == (4, 4)


@pytest.mark.slow
def test_a_first_look_at_all_methods_is_quick(capsys: pytest.CaptureFixture[str]) -> None:
    methods = ["dro", "synthesise", "dfc", "start"]
    begin = time.process_time()
    assert main(["benchmark", "--method", *methods, "--quick", "--hands", "barrett", "--objects", "can", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["grasps"], row["stage"], row["num"]) for row in rows] == [(name, "returned", 4) for name in methods]
    assert time.process_time() - begin < 120, "a minute of two cores, whatever else they do"
