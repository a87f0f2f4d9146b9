"""What is not asked for is the same on the command line, in Python and in the viewer."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from typing import Any

import pytest

from dro_grasp.apps.report import protocol_for
from dro_grasp.cli.dataset import Synthesize
from dro_grasp.cli.evaluate import Evaluate
from dro_grasp.cli.generate import Generate
from dro_grasp.cli.inputs import ConstraintOptions
from dro_grasp.cli.main import THREADS, WAIT_POLICY, main
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.contacts import ContactConfig
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.stages import evaluate
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL
from dro_grasp.simulation.trial import record, settle_many, simulate
from dro_grasp.training.data.engine.worker import EngineConfig
from tests.helpers.served_studio import Listener, asked, served_studio

REQUESTS = {"num": 16, "seed": 0, "candidates": 4, "refine": True, "temperature": None, "source": "auto"}
CONSTRAINTS = {"direction": None, "table": None, "max_tilt": None, "obstacles": None, "contact_region": (), "keep_out": (),
               "pregrasp_clearance": None, "margin": None, "max_force": None}


def default(function: Callable[..., Any], name: str) -> Any:
    return inspect.signature(function).parameters[name].default


def test_a_request_has_the_same_defaults_everywhere() -> None:
    for name, value in REQUESTS.items():
        assert getattr(GraspRequest(), name) == value
        assert default(Generate, name) == value, f"generate --{name}"
    fields = inspect.signature(ConstraintOptions).parameters
    for name, value in CONSTRAINTS.items():
        option = default(ConstraintOptions if name in fields else Generate, name)
        assert getattr(Constraints(), name) == option == value, name
    assert {default(GraspPredictor.predict, name) == REQUESTS[name] for name in ("num", "seed")} == {True}


def test_data_are_made_alike() -> None:
    assert default(Synthesize, "idle") == ContactConfig().idle
    assert default(Synthesize, "protocol") == EngineConfig().protocol
    assert default(Synthesize, "keep_idle_fingers") is not EngineConfig().close_fingers


@pytest.mark.filterwarnings("default::DeprecationWarning", "default::ResourceWarning")
def test_the_viewer_asks_for_what_the_command_asks(tmp_path) -> None:
    with served_studio(tmp_path, Listener) as studio:
        problem, request = asked(studio)
        assert (request, problem.constraints) == (GraspRequest(), Constraints())
        assert studio.protocol.value == DEFAULT_PROTOCOL


@pytest.mark.parametrize("function", [simulate, settle_many, record, evaluate, Evaluate])
def test_trials_are_those_of_what_lifts_things_unless_another_protocol_is_named(function: Callable[..., Any]) -> None:
    assert default(function, "protocol") == DEFAULT_PROTOCOL == "carry"


def test_so_are_those_of_generate() -> None:
    assert protocol_for(load_object("sphere"), Generate(hand="gripper3", object="sphere").protocol) == "carry"


def test_waiting_threads_sleep_unless_the_user_says_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(WAIT_POLICY[0], raising=False)
    assert main(["hands", "--json"]) == 0
    assert os.environ[WAIT_POLICY[0]] == "PASSIVE"
    monkeypatch.setenv(WAIT_POLICY[0], "ACTIVE")
    assert main(["hands", "--json"]) == 0
    assert os.environ[WAIT_POLICY[0]] == "ACTIVE"


@pytest.mark.parametrize("given", [["--threads", "3", "hands"], ["hands", "--threads=3"], ["hands"]])
def test_threads_are_chosen_at_any_place(monkeypatch: pytest.MonkeyPatch, given: list[str]) -> None:
    monkeypatch.setenv(THREADS, "5")
    assert main([*given, "--json"]) == 0
    assert os.environ[THREADS] == ("5" if given == ["hands"] else "3")


@pytest.mark.parametrize("number", ["0", "-1", "two", ""])
def test_threads_that_are_none_are_refused(capsys: pytest.CaptureFixture[str], number: str) -> None:
    assert main(["hands", "--threads", number]) == 2
    assert f"--threads is '{number}'; give a number" in capsys.readouterr().err
