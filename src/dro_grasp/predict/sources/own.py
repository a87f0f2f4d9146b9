"""Sources of others: objects of yours that propose or predict, and grasps that somebody stored in a file."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, TypeVar

import torch

from dro_grasp.errors import DroGraspError, GraspFileError, OptionError
from dro_grasp.grasps.batch import GraspBatch, load_grasps
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.source import Candidates, Progress, Source


class OwnSource(Source):
    """An object of yours with `predict(hand, obj, num, seed)` or `propose(problem, num, seed)`, whose grasps are checked."""

    def __init__(self, name: str, proposer: Any) -> None:
        """Take an object that can propose.

        Raises:
            OptionError: It cannot.
        """
        self.name, self.proposer = name, proposer
        if not any(callable(getattr(proposer, verb, None)) for verb in ("predict", "propose")):
            raise OptionError(f"source '{name}' has no predict(hand, obj, num, seed); give its class one that returns a "
                              "GraspBatch (GraspBatch.create makes one from wrist poses and joints)")

    def propose(
        self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None
    ) -> Candidates | GraspBatch:
        """What it proposes, `num` at most; it may use gradients, which predictors turn off.

        Raises:
            OptionError: It fails, or returns something else than grasps of this hand on this object.
        """
        try:
            with torch.enable_grad():
                if callable(getattr(self.proposer, "propose", None)):
                    made = self.proposer.propose(problem, num, seed)
                else:
                    made = self.proposer.predict(problem.hand, problem.obj, num, seed)
        except DroGraspError:
            raise
        except Exception as error:  # the code is not ours: any fault of it is the user's to see
            raise OptionError(f"source '{self.name}' failed: {type(error).__name__}: {error}") from error
        grasps = made.grasps if isinstance(made, Candidates) else made
        if not isinstance(grasps, GraspBatch):
            raise OptionError(f"source '{self.name}' returned a {type(grasps).__name__}, expected a GraspBatch; make one with "
                              "GraspBatch.create(hand, obj, T_object_wrist, joints)")
        grasps.require_hand(problem.hand)
        if set(grasps.object) - {problem.obj.name}:
            raise OptionError(f"source '{self.name}' returned grasps of {', '.join(sorted(set(grasps.object)))}, asked for was "
                              f"'{problem.obj.name}'; give GraspBatch.create the object that it was asked for")
        return _detached(made[:num])

    def knows(self, hand: Hand) -> bool:
        """What it says itself; any hand, if it says nothing."""
        says = getattr(self.proposer, "knows", None)
        return bool(says(hand)) if callable(says) else True


Made = TypeVar("Made", Candidates, GraspBatch)


def _detached(made: Made) -> Made:
    """The same without the graph of a descent that made it."""
    if isinstance(made, Candidates):
        return dataclasses.replace(made, grasps=_detached(made.grasps), points=made.points.detach())
    tensors = {f.name: value.detach() for f in dataclasses.fields(made)
               if isinstance(value := getattr(made, f.name), torch.Tensor)}
    extra = {name: value.detach() if isinstance(value, torch.Tensor) else value for name, value in made.extra.items()}
    return made.replace(**tensors, extra=extra)


class FileSource(Source):
    """Stored grasps, such as `dataset import` makes of other projects' files; outcomes and scores in them count for nothing."""

    def __init__(self, path: Path) -> None:
        """Read the file, or all files of a folder.

        Raises:
            GraspFileError: It cannot be read, or holds no grasp.
        """
        self.name, self.grasps = path.stem, load_grasps(path)

    def knows(self, hand: Hand) -> bool:
        """The hand of the file."""
        return hand.name == self.grasps.hand

    def asked(self, obj: ObjectModel, num: int) -> int:
        """As many as the file was asked for, or, where it does not know, as there are."""
        return min(num, self._stored(obj).out_of)

    def _stored(self, obj: ObjectModel) -> GraspBatch:
        """The stored grasps of an object."""
        parts = [part for _, part in self.grasps.by_object() if part.object[0] == obj.name]
        if not parts and (asked := {key: n for key, n in self.grasps.asked_of.items() if key[0] == obj.name}):
            return self.grasps[:0].replace(asked_of=asked)  # an answer of nothing
        if not parts:
            held = ", ".join(sorted(set(self.grasps.object))[:5])
            raise GraspFileError(f"'{self.name}' holds no grasp of '{obj.name}', but of {held}; ask for "
                                 "grasps of one of these, or give another file")
        return GraspBatch.concatenate(parts)

    def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> GraspBatch:
        """Some of the stored grasps of the object, drawn at random; all if there are not enough.

        Of an answer with fewer grasps than were asked for, a part of the request is drawn, and with it a part of the grasps.

        Raises:
            GraspFileError: There is none, or it is of other geometry.
        """
        found = self._stored(problem.obj)
        self.grasps.require_hand(problem.hand)
        if wrong := set(found.object_sha256) - {problem.obj.sha256, ""}:
            raise GraspFileError(f"'{self.name}' holds grasps of another '{problem.obj.name}' ({wrong.pop()[:12]}, not "
                                 f"{problem.obj.sha256[:12]}); evaluate them on the object that they were made for")
        drawn = torch.randperm(found.out_of, generator=torch.Generator().manual_seed(seed))[:num]
        stored = found[drawn[drawn < len(found)]]
        return stored.without("score").without_trial()
