"""Shape checks for every test, and the fixtures that several files share."""

from __future__ import annotations

import os
from pathlib import Path

# Each worker of pytest-xdist has a core of its own; with more threads they wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import jaxtyping
import pytest

import tests.typecheck  # noqa: F401  (must be imported before the hook is installed)

jaxtyping.install_import_hook("dro_grasp", "tests.typecheck.check")


@pytest.fixture(scope="session")
def assets_folder() -> Path:
    folder = os.environ.get("DRO_GRASP_ASSETS")
    if not folder or not Path(folder).is_dir():
        pytest.skip("needs the development assets: set DRO_GRASP_ASSETS to their folder")
    return Path(folder)
