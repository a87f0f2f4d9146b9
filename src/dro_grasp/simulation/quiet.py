"""MuJoCo without its warnings on the terminal and in log files."""

from __future__ import annotations

import threading

import mujoco


class _Quiet:
    """MuJoCo's handler of warnings, which is the process's: the first block sets it, the last that ends gives it back."""

    def __init__(self) -> None:
        self._lock, self._blocks, self._before = threading.Lock(), 0, None

    def __enter__(self) -> None:
        with self._lock:
            if self._blocks == 0:
                self._before = mujoco.get_mju_user_warning()
                mujoco.set_mju_user_warning(_ignore)
            self._blocks += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._blocks -= 1
            if self._blocks == 0:
                mujoco.set_mju_user_warning(self._before)


_QUIET = _Quiet()  # The only one


def quiet() -> _Quiet:
    """A block in which MuJoCo writes no warnings to the terminal or to a log in the working folder, in any thread."""
    return _QUIET


def _ignore(message: str) -> None:
    """Each trial counts its warnings; their text adds nothing."""
