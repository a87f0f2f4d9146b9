"""The command that serves grasps, where it does not come to serving."""

from __future__ import annotations

import socket

import pytest

from dro_grasp.cli.main import main
from dro_grasp.serve import web_extra


@pytest.mark.parametrize("missing", web_extra.PACKAGES)
def test_without_the_extra_serving_says_what_to_install(
    missing: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(web_extra, "find_spec", lambda name: None if name == missing else object())
    with socket.create_server(("127.0.0.1", 0)) as taken:  # otherwise it would serve for ever
        assert main(["serve", "--port", str(taken.getsockname()[1])]) == 2
    assert f"not installed: {missing}; run pip install '.[serve]' in the folder of the clone" in capsys.readouterr().err
