"""Shape checks, and the fixtures that several files share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

# Each worker of pytest-xdist has a core of its own; with more threads they wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch

# PyTorch's optimisers import Triton, which then is a compiler or an interpreter for good.
if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")

if os.environ.get("CHECK_SHAPES"):  # as `make test-full` sets it
    import jaxtyping

    import tests.helpers.typecheck  # noqa: F401  (must be imported before the hook is installed)

    jaxtyping.install_import_hook("dro_grasp", "tests.helpers.typecheck.check")


@pytest.fixture
def as_users_have_it() -> None:
    """Skips where the check of shapes comes first, and refuses by its own words."""
    if os.environ.get("CHECK_SHAPES"):
        pytest.skip("shapes are checked; make test runs it")


@pytest.fixture(scope="session", autouse=True)
def every_grasp_is_returned() -> Iterator[None]:
    """Untrained weights and few steps make grasps that do not hold; tests of anything else than trust still need some."""
    from dro_grasp.predict import finish

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finish, "LEAST_CONFIDENCE", 0.0)
        yield


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The file of untrained weights."""
    from tests.helpers.weights import untrained_weights

    return str(untrained_weights(tmp_path_factory.mktemp("weights")))


@pytest.fixture(scope="session")
def assets_folder() -> Path:
    folder = os.environ.get("DRO_GRASP_ASSETS")
    if not folder or not Path(folder).is_dir():
        pytest.skip("needs the development assets: set DRO_GRASP_ASSETS to their folder")
    return Path(folder)


@pytest.fixture(params=["fake", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> Iterator[str]:
    """A device that is not the CPU: the strict fake one, and with the marker `gpu` a real one."""
    from tests.helpers.fake_device import fake_device

    if request.param == "fake":
        with fake_device() as name:
            yield name
    elif not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    else:
        yield request.param


@pytest.fixture(scope="session")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the tiny bundle and the runs on it lie."""
    return tmp_path_factory.mktemp("training")


@pytest.fixture(scope="session")
def bundle(home: Path):
    from tests.helpers.tiny_bundle import tiny_bundle

    return tiny_bundle(home / "bundle.safetensors")


@pytest.fixture(scope="session")
def results(home: Path, bundle) -> dict:
    """What uninterrupted runs of both stages of training return, by stage."""
    from tests.helpers.training_stages import STAGES, run_stage

    return {stage: run_stage(stage, bundle, home / stage) for stage in STAGES}


@pytest.fixture(scope="session")
def finished(home: Path, results: dict) -> dict[str, Path]:
    """The folders of these runs."""
    return {stage: home / stage for stage in results}


@pytest.fixture(scope="session")
def robot():
    """The built-in xArm 7 with a LEAP hand."""
    from dro_grasp.arm.robots.loading import load_robot

    return load_robot("xarm7_leaphand")


@pytest.fixture(scope="session")
def small_robot(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The file of the built-in xArm 7 with a hand that loads quickly, and without a camera."""
    import yaml

    from dro_grasp.arm.robots.loading import BUILTIN_ROBOTS

    values = yaml.safe_load((BUILTIN_ROBOTS / "xarm7_leaphand.yaml").read_text())
    # This hand's palm faces along the flange, LEAP's across it.
    mount = {"link": "link7", "position": [0.0, 0.0, 0.03], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
    values |= {"arm": str(BUILTIN_ROBOTS / "xarm7.urdf"), "hand": "gripper3", "mount": mount}
    del values["camera"]
    path: Path = tmp_path_factory.mktemp("robot") / "small.yaml"
    path.write_text(yaml.safe_dump(values))
    return str(path)


@pytest.fixture
def quick_statistics(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands that train measure the statistics of BatchNorm over two batches, which takes most of so short a run."""
    from dro_grasp.training import loop
    from dro_grasp.training.runs import recalibrate

    monkeypatch.setattr(loop, "recalibrate", lambda model, forward, _: recalibrate(model, forward, 2))
