"""Methods by name: those of this package, classes of yours, and grasp files."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dro_grasp.baselines.controls import MeanGraspMethod, StartMethod
from dro_grasp.baselines.foreign import FileMethod, ForeignMethod
from dro_grasp.baselines.method import Method
from dro_grasp.baselines.ours import DescentMethod, DistanceMethod, SynthesisMethod
from dro_grasp.datasets.bundle.training_file import Bundle
from dro_grasp.errors import OptionError
from dro_grasp.files import given_path
from dro_grasp.kinds import Checked
from dro_grasp.predictor import GraspPredictor, PredictorConfig


@dataclass(frozen=True)
class MethodOptions(Checked):
    """What methods are made with."""

    weights: str | None = None
    """Name or path of weights; the method's shipped ones if omitted."""
    device: str = "cpu"
    """Where networks run."""
    temperature: float | None = None
    """Spread of z of the D(R,O) network."""
    bundle: Bundle | None = None
    """Training grasps, for the mean grasp."""


def _dro(options: MethodOptions) -> Method:
    return DistanceMethod(
        GraspPredictor(options.weights, options.device, PredictorConfig(temperature=options.temperature)))


def _mean(chosen: bool, options: MethodOptions) -> Method:
    if options.bundle is None:
        raise OptionError("the mean grasp needs training grasps; give a bundle (--bundle PATH)")
    return MeanGraspMethod(options.bundle, chosen)


METHODS: dict[str, Callable[[MethodOptions], Method]] = {
    "dro": _dro,
    "synthesise": lambda options: SynthesisMethod(),
    "dfc": lambda options: DescentMethod(),
    "start": lambda options: StartMethod(),
    "mean-grasp": lambda options: _mean(False, options),
    "mean-grasp-chosen": lambda options: _mean(True, options),
}
"""Methods of this package."""
MOVED = {
    "gendexgrasp": "lab.methods.gendexgrasp:GenDexGrasp", "gendexgrasp-gamma1": "lab.methods.gendexgrasp:GenDexGraspGamma1",
    "manifm": "lab.methods.manifm:ContactMethod",
}
"""Methods that were of this package, and are classes in its repository now."""


def make_method(name: str, options: MethodOptions | None = None) -> Method:
    """A method, ready to make grasps.

    Args:
        name: One of METHODS; `dro` with weights of its own, as `dro@my_weights.safetensors`; `module:Class`,
            a class without arguments whose objects have `predict(hand, obj, num, seed)`; or a grasp file.
        options: What methods are made with.

    Raises:
        OptionError: There is no such method, or it lacks what it needs.
        GraspFileError: The grasp file cannot be read.
    """
    options = options or MethodOptions()
    plain, at, weights = name.partition("@")
    if plain in METHODS and (not at or plain == "dro"):
        method = METHODS[plain](replace(options, weights=weights) if at else options)
        if at:
            method.name = name
        return method
    if name.endswith(".parquet") or given_path(name).is_dir():
        return FileMethod(given_path(name))
    module, colon, attribute = name.partition(":")
    if colon:
        made = _foreign_class(module, attribute)()
        return made if isinstance(made, Method) else ForeignMethod(name, made)
    if plain in MOVED:
        raise OptionError(f"method '{plain}' is not part of the package any more; in a clone of the repository, name it as "
                          f"{MOVED[plain]}")
    raise OptionError(f"there is no method '{name}'; choose {', '.join(METHODS)}, give dro weights as dro@PATH, "
                      "name a class of your own as module:Class, or give a grasp file (.parquet)")


def _foreign_class(module: str, attribute: str) -> Callable[[], Any]:
    """A class by its module and name; modules in the working directory are found too.

    Raises:
        OptionError: It cannot be imported.
    """
    if str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise OptionError(f"method '{module}:{attribute}' cannot be imported ({error}); give a module that Python finds from "
                          "here, and a class in it") from error
