"""The folder of a training run: its log, the checkpoint from which it resumes, and what it must have in common with it."""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch

from dro_grasp.errors import OutputError, TrainingError
from dro_grasp.files import FOREIGN, UNTYPED, is_unread, reason_of, replacing, set_aside
from dro_grasp.kinds import flat
from dro_grasp.network.network import DistanceNetwork
from dro_grasp.network.presets import NetworkConfig
from dro_grasp.train.data.bundle.training_file import Bundle

CHECKPOINT = "checkpoint.pt"  # File with everything that a run needs to resume
LOG = "log.jsonl"  # File with one JSON object a line: step, seconds, learning rate and mean losses
ENTRIES = ("step", "seconds", "model", "average", "optimiser", "plan")  # Entries of a checkpoint


@dataclass(frozen=True)
class RunFolder:
    """Log and checkpoint of one run; where several processes train, the first alone uses it."""

    path: Path

    def write_checkpoint(self, state: dict[str, Any]) -> None:
        """Replace the checkpoint, whole or not at all."""
        path, temporary, content = self.path / CHECKPOINT, self.path / f"{CHECKPOINT}.part", io.BytesIO()
        torch.save(state, content)  # its own writer says of a full disk that a position was not expected
        try:
            with self._writing(path):
                temporary.write_bytes(content.getbuffer())
                os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)

    def read_checkpoint(self, plan: dict[str, Any]) -> dict[str, Any] | None:
        """The checkpoint, which must have the same plan; None where there is none.

        A damaged one is set aside with its log, and the run begins anew: there is nothing else to go on from. One that
        cannot be read now may be sound, and is left alone.
        """
        path = self.path / CHECKPOINT
        if not path.is_file():
            return None
        try:
            state = _state(path)
        except FOREIGN as error:
            if is_unread(error):
                raise TrainingError(f"{path} cannot be read ({reason_of(error)}); nothing was changed. Start again once it can "
                                    "be, or use another folder") from error
            with self._writing(path):
                aside = set_aside(path, self.path / LOG)
            print(f"{path} is damaged ({type(error).__name__}) and set aside as {aside.name}, its log beside it; the training "
                  "begins anew", file=sys.stderr)
            return None
        found = state["plan"]
        for name, asked in plan.items():
            if found.get(name, asked) != asked:  # earlier versions stored less
                raise TrainingError(f"{path} belongs to a run with {name} {found[name]}, {asked} was asked for; use the "
                                    "same to resume, or another folder")
        return state

    def misfit(self, error: Exception) -> TrainingError:
        """The error of a checkpoint that cannot be used."""
        reason = str(error).partition("\n")[0] or "it is empty"
        return TrainingError(f"{self.path / CHECKPOINT} does not fit this training ({reason}); use another folder, or the "
                             "configuration it was made with")

    def append_to_log(self, line: dict[str, float]) -> None:
        """Write one line of the log."""
        with self._writing(self.path / LOG), (self.path / LOG).open("a") as file:
            file.write(json.dumps(line) + "\n")

    def cut_log(self, step: int) -> None:
        """Drop the lines after a step, among them one that was cut short."""
        log = self.path / LOG
        if not log.is_file():
            return
        kept = []
        for line in log.read_text(errors="replace").splitlines():
            try:
                if json.loads(line)["step"] <= step:
                    kept.append(line)
            except (ValueError, LookupError, TypeError, RecursionError):
                break
        with replacing(log, "the log") as temporary:
            temporary.write_text("".join(line + "\n" for line in kept))

    @contextmanager
    def _writing(self, path: Path) -> Iterator[None]:
        """Explain a full disk or a missing permission, and what is left."""
        try:
            yield
        except OSError as error:
            there = (self.path / CHECKPOINT).is_file()
            left = "the run resumes from its last checkpoint" if there else "there is no checkpoint yet, so the run begins anew"
            raise OutputError(f"cannot write {path}: {error.strerror or error}; free some space, or make it writable, and "
                              f"start again: {left}") from error


def _state(path: Path) -> dict[str, Any]:
    content = io.BytesIO(path.read_bytes())  # PyTorch's reader would hide a failing disk in a RuntimeError
    try:
        state = torch.load(content, weights_only=True, map_location="cpu")
    except UNTYPED as error:  # PyTorch takes a damaged pickle's entries for what they should be
        raise ValueError(str(error)) from error
    kinds = {"step": int, "seconds": (int, float), "plan": dict}
    if not isinstance(state, dict) or not set(ENTRIES) <= state.keys() or not all(
            isinstance(state[name], kind) for name, kind in kinds.items()):
        raise ValueError("it is no checkpoint")
    return state


def last_logged(folder: Path) -> dict[str, float]:
    """The last line of a run's log: steps, seconds and losses at its end."""
    return json.loads((folder / LOG).read_text().splitlines()[-1])


BOOKKEEPING = frozenset({"minutes", "device", "log_every", "checkpoint_seconds", "tensorboard"})
"""Settings of a schedule that a resumed run may change: how long it goes on, where, and what it tells."""


def run_plan(
    config: Any, bundle: Bundle, network: NetworkConfig | None = None, **given: DistanceNetwork | None
) -> dict[str, Any]:
    """What determines the curve of a run, by name: settings of the stage and its network, content of the data, weights.

    `given` are weights that the run begins with or takes parts of, by role; their parameters count, not their names.
    """
    settings = {name: value for name, value in flat(config).items() if name.removeprefix("schedule.") not in BOOKKEEPING}
    weights = {role: None if each is None else _digest(each) for role, each in given.items()}
    about = {} if network is None else flat(network, "network.")
    return {name.removeprefix("schedule."): value for name, value in settings.items()} | about | weights | {
        "bundle": bundle.fingerprint}


def _digest(network: DistanceNetwork) -> str:
    """Twelve digits that tell parameters apart; statistics of BatchNorm do not count, as each sitting measures its own."""
    digest = sha256()
    for parameter in network.parameters():
        digest.update(parameter.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:12]
