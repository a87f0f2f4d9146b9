"""Sources by name: those of this package, those that were registered, classes of yours, and grasp files."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from dro_grasp.errors import DroGraspError, OptionError
from dro_grasp.predict.sources.controls import MeanGrasp, MeanGraspSource, StartSource
from dro_grasp.predict.sources.optimiser import DescentSource
from dro_grasp.predict.sources.own import FileSource, OwnSource
from dro_grasp.predict.sources.source import AUTO, Source

SOURCES: dict[str, Callable[[], Any]] = {"dfc": DescentSource, "start": StartSource}
"""What makes each source that needs nothing; `register_source` adds yours. A predictor has `network` and `optimiser` too."""
OF_THE_PREDICTOR = ("network", "optimiser")  # Sources that a predictor makes, with its weights and configuration
WITH_DATA = ("mean-grasp", "mean-grasp-chosen")  # Controls that need the mean of training grasps


def register_source(name: str, factory: Callable[[], Any]) -> None:
    """Give a source of yours a name that `predict`, `generate`, `benchmark` and `plan` know from then on.

    Args:
        name: A new name.
        factory: A class or function without arguments. What it returns is a `Source`, or has `predict(hand, obj, num, seed)`
            or `propose(problem, num, seed)`, either of which returns a GraspBatch.

    Raises:
        OptionError: The name is taken, or could be mistaken for a file or a class.
    """
    if name in source_names() or name in (AUTO, *WITH_DATA):
        raise OptionError(f"there is a source '{name}' already; choose another name")
    if not name or set(name) & set(":@/\\") or name.endswith(".parquet"):
        raise OptionError(f"'{name}' is no name of a source; give one without : @ / and without .parquet")
    SOURCES[name] = factory


def source_names() -> tuple[str, ...]:
    """Names of all sources that every predictor knows."""
    return (*OF_THE_PREDICTOR, *SOURCES)


def source_or_name(name: str) -> str | Source:
    """A source that needs no predictor; of the others, and of the rule `auto`, the name.

    Raises:
        OptionError: See `make_source`.
        GraspFileError: Likewise.
    """
    return name if name in (AUTO, *OF_THE_PREDICTOR) else make_source(name)


def make_source(name: str, means: Mapping[str, MeanGrasp] | None = None) -> Source:
    """A source that needs no predictor.

    Args:
        name: One of SOURCES or WITH_DATA; `module:Class`, a class of yours as `register_source` takes it; or a grasp file.
        means: Mean training grasps by hand, for the controls WITH_DATA.

    Raises:
        OptionError: There is no such source, or it lacks what it needs.
        GraspFileError: The grasp file cannot be read.
    """
    if name in (AUTO, *OF_THE_PREDICTOR):
        raise OptionError(f"source '{name}' needs a network and a configuration; GraspPredictor().source('{name}') makes it")
    if name in SOURCES:
        return _as_source(name, _made(name, SOURCES[name]))
    if name in WITH_DATA:
        if means is None:
            raise OptionError(f"{name} needs training grasps; give a bundle (bundle=PATH)")
        return MeanGraspSource(means, chosen=name.endswith("chosen"))
    if name.endswith(".parquet") or Path(name).is_dir():
        return FileSource(Path(name))
    module, colon, attribute = name.partition(":")
    if colon:
        return _as_source(name, _made(name, _own_class(module, attribute)))
    names = AUTO, *source_names(), *(() if means is None else WITH_DATA)
    raise OptionError(f"there is no source '{name}'; choose {', '.join(names)}, name a class of your own as module:Class, or "
                      "give a grasp file (.parquet)")


def _made(name: str, factory: Any) -> Any:
    """What a factory makes.

    Raises:
        OptionError: It needs arguments, is nothing that can be called, or fails.
    """
    try:
        return factory()
    except DroGraspError:
        raise
    except Exception as error:  # the code is not ours: any fault of it is the user's to see
        raise OptionError(f"source '{name}' cannot be made without arguments ({type(error).__name__}: {error}); give a class "
                          "or function that takes none, such as one that calls yours with what it needs") from error


def _as_source(name: str, made: Any) -> Source:
    """What a factory returned, under its own name or the one that it was asked for by."""
    if not isinstance(made, Source):
        return OwnSource(name, made)
    if not hasattr(made, "name"):
        made.name = name
    return made


def _own_class(module: str, attribute: str) -> Any:
    """A class by its module and name; modules in the working directory are found too."""
    if str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    try:
        return getattr(importlib.import_module(module), attribute)
    except Exception as error:  # as above
        raise OptionError(f"source '{module}:{attribute}' cannot be imported ({type(error).__name__}: {error}); give a module "
                          "that Python finds from here, and a class in it") from error
