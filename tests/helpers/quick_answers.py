"""A stand-in for what answers in the computing process of a grasp server: it starts at once and fails in its own ways."""

from __future__ import annotations

import os
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from dro_grasp.errors import OptionError


class QuickAnswerer:
    """Does what each call says."""

    def __init__(self, config: Any) -> None:
        """Load nothing.

        Raises:
            OptionError: The configuration is `broken`.
        """
        if config == "broken":
            raise OptionError("the weights are broken; mend them")
        if config == "deadly":
            os._exit(7)

    def hand_names(self) -> list[str]:
        return ["claw"]

    def object_names(self) -> list[str]:
        return ["can"]

    def answer(self, call: Any, progress: Callable[[int, int], None]) -> Any:
        """`echo`, `die`, be `killed`, `nap` for half a second, `sleep` until it is cancelled, or `hang` whatever is said.

        `file` hangs after it has made a temporary file.
        """
        if call.hand == "die":
            os._exit(7)
        if call.hand == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        if call.hand == "wrong":
            raise OptionError("num is 0")
        if call.hand == "faulty":
            raise ZeroDivisionError
        if call.hand == "file":
            (Path(tempfile.mkdtemp()) / "mesh.stl").touch()
        if call.hand in {"file", "hang"}:
            time.sleep(60)
        if call.hand == "nap":
            time.sleep(0.5)
        while call.hand == "sleep":
            progress(0, 1)
            time.sleep(0.01)
        return SimpleNamespace(model_dump_json=lambda: call.id)
