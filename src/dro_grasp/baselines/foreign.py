"""Methods of others: objects with a `predict` of their own, and grasps that somebody stored in a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import torch

from dro_grasp.baselines.method import Method
from dro_grasp.errors import DroGraspError, GraspFileError, OptionError
from dro_grasp.grasps.batch import GraspBatch, load_grasps
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.pipeline.problem import GraspProblem


class Predicts(Protocol):
    """What a class of yours has to offer."""

    def predict(self, hand: Hand, obj: ObjectModel, num: int, seed: int) -> GraspBatch:
        """Grasps of an object, as `GraspBatch.create` makes them from wrist poses and joints."""
        ...


class ForeignMethod(Method):
    """An object of yours as a method."""

    def __init__(self, name: str, predictor: Any) -> None:
        """Take an object that can predict, as `Predicts` says.

        Raises:
            OptionError: It cannot.
        """
        if not callable(getattr(predictor, "predict", None)):
            raise OptionError(f"method '{name}' has no predict(hand, obj, num, seed); give its class one that returns a "
                              "GraspBatch (GraspBatch.create makes one from wrist poses and joints)")
        self.name = name
        self.predictor: Predicts = predictor

    def make(self, problem: GraspProblem, num: int, seed: int) -> GraspBatch:
        """What it predicts.

        Raises:
            OptionError: It fails, or returns something else than grasps of this hand on this object.
        """
        try:
            grasps = self.predictor.predict(problem.hand, problem.obj, num, seed)
        except DroGraspError:
            raise
        except Exception as error:  # code of the user's runs here: its faults are told with the method's name
            raise OptionError(f"method '{self.name}' failed: {type(error).__name__}: {error}") from error
        if not isinstance(grasps, GraspBatch):
            raise OptionError(f"method '{self.name}' returned a {type(grasps).__name__}, expected a GraspBatch; make one with "
                              "GraspBatch.create(hand, obj, T_object_wrist, joints)")
        grasps.require_hand(problem.hand)
        if set(grasps.object) - {problem.obj.name}:
            raise OptionError(f"method '{self.name}' returned grasps of {', '.join(sorted(set(grasps.object)))}, asked for was "
                              f"'{problem.obj.name}'; give GraspBatch.create the object that it was asked for")
        return grasps[:num]


class FileMethod(Method):
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
        """The stored grasps of an object.

        Raises:
            GraspFileError: There is none.
        """
        parts = [part for _, part in self.grasps.by_object() if part.object[0] == obj.name]
        if not parts:
            held = ", ".join(sorted(set(self.grasps.object))[:5])
            raise GraspFileError(f"'{self.name}' holds no grasp of '{obj.name}', but of {held}; name its objects with "
                                 "--objects")
        return GraspBatch.concatenate(parts)

    def make(self, problem: GraspProblem, num: int, seed: int) -> GraspBatch:
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
