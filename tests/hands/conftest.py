"""Hands are derived in each test here, as if no test had derived them before."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache that is empty: what a test puts in place of code must not be stored, nor be passed over for what is stored."""
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("DRO_GRASP_CACHE", str(folder))
    return folder
