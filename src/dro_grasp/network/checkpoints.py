"""Weights files: safetensors, half precision, with the network's configuration inside; never pickle."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Num
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from dro_grasp.errors import WeightsError
from dro_grasp.files import UNTYPED, given_path, reading, replacing
from dro_grasp.network.network import DistanceNetwork
from dro_grasp.network.presets import LAST_WITH_OTHERS, NetworkConfig

Network = TypeVar("Network", bound=nn.Module)
Tensors = dict[str, Num[Tensor, "..."]]  # Tensors of a file by name
SHIPPED_FOLDER = Path(__file__).parent / "weights"  # Folder of the shipped weights
KEY = "dro_grasp_weights"  # Metadata entry that marks a safetensors file as weights of this package; JSON
FORMAT_VERSION = 1  # Version of that entry
PICKLES = (b"PK", b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")  # First two bytes of zipped and of bare pickles
CHECKSUMS = "SHA256SUMS"  # File beside the shipped weights with their checksums, as `sha256sum` writes it
SMALL = ("completion/surface", "ranking/quality", "ranking/holding")  # Networks that ship beside those that predict D(R,O)
DEFAULT = "more_objects"  # Name of the default weights
FORMER_WEIGHTS = ("multi", "more_hands")  # Names of weights that shipped before


def save_weights(
    network: nn.Module, path: Path | str, about: dict[str, Any] | None = None, history: Sequence[dict[str, Any]] = ()
) -> None:
    """Write weights in half precision; counters and statistics of BatchNorm stay in single precision.

    Args:
        network: A network that predicts grasps, whose configuration goes along, or a small one that ships beside it.
        about: How the weights were made, and on what data.
        history: The same of the weights that training began with, oldest first (`history_of`).

    Raises:
        OutputError: The path cannot be written.
    """
    path = given_path(path)
    tensors = {
        name: value.half().contiguous() if value.is_floating_point() and "running" not in name else value.contiguous()
        for name, value in network.state_dict().items()
    }
    config = {"config": dataclasses.asdict(network.config)} if isinstance(network, DistanceNetwork) else {}
    entry = {"format_version": FORMAT_VERSION, **config, "about": about or {}, "history": list(history)}
    with replacing(path, "weights") as temporary:
        save_file(tensors, temporary, metadata={KEY: json.dumps(entry)})


def load_weights(name: str | Path | None = None) -> DistanceNetwork:
    """A network with trained weights, in evaluation mode and single precision.

    Args:
        name: Name of shipped weights, or the path of a weights file; None takes the default.

    Raises:
        WeightsError: No such weights, or the file is truncated, foreign, a pickle, or of another version.
    """
    path = locate_weights(name)
    entry, tensors = _read(path)
    with reading(path, WeightsError, "weights of this version of the network", *UNTYPED):
        config = NetworkConfig.from_dict(entry["config"])
        with torch.device("meta"):  # a network of the wrong size is never made
            _check_tensors(DistanceNetwork(config).state_dict(), tensors, path)
        return _filled(DistanceNetwork(config, name=path.stem), tensors)


def _filled(network: Network, tensors: Tensors) -> Network:
    network.load_state_dict({k: v.float() if v.is_floating_point() else v for k, v in tensors.items()})
    return network.eval()


def _check_tensors(expected: Tensors, given: Tensors, path: Path) -> None:
    """Refuse tensors that are missing, of another shape or type, not finite, or negative variances."""
    for name in expected.keys() | given.keys():
        wanted, tensor = expected.get(name), given.get(name)
        if wanted is None or tensor is None:
            raise WeightsError(f"{path} {'lacks the tensor' if tensor is None else 'has a tensor too many,'} '{name}'; use "
                               "weights made with this version")
        if tensor.shape != wanted.shape or tensor.is_floating_point() != wanted.is_floating_point() or tensor.is_complex():
            raise WeightsError(f"{path}: '{name}' is {tensor.dtype} of shape {tuple(tensor.shape)}, expected {wanted.dtype} "
                               f"of shape {tuple(wanted.shape)}; use weights made with this version")
        finite = not tensor.is_floating_point() or bool(tensor.isfinite().all())
        if not finite or ("running_var" in name and bool((tensor < 0).any())):
            raise WeightsError(f"{path}: '{name}' holds NaN, infinity, or a negative variance; train again")


def load_small(path: Path, make: Callable[[Tensors], Network], expected: str) -> Network:
    """A small network that ships beside those that predict D(R,O), in evaluation mode; its gradients are switched off.

    `make` makes the network of the size that the file's tensors have; `expected` is what the file should be, and a remedy.
    """
    tensors = _read(path)[1]
    with reading(path, WeightsError, expected):
        network = make(tensors)
        _check_tensors(network.state_dict(), tensors, path)
        return _filled(network, tensors).requires_grad_(False)


def history_of(path: Path) -> list[dict[str, Any]]:
    """How the weights of a file were made: one entry a training, oldest first; empty where the file does not say."""
    entry = _read(path)[0]
    return [*entry["history"], *([entry["about"]] if entry["about"] else [])]


def locate_weights(name: str | Path | None = None) -> Path:
    """The file behind a name."""
    text = str(name or DEFAULT)
    shipped = SHIPPED_FOLDER / f"{text}.safetensors"
    if "/" not in text and os.path.isfile(shipped):
        return shipped
    path = given_path(text)
    if path.is_file():
        return path
    if text in FORMER_WEIGHTS:
        raise WeightsError(f"the weights '{text}' no longer ship: the last state with them is {LAST_WITH_OTHERS}, in "
                           f"src/dro_grasp/weights; use '{DEFAULT}', the default, instead")
    raise WeightsError(f"no weights at '{text}'; shipped weights are {', '.join(weights_names()) or 'none'}, or give the "
                       "path of a .safetensors file that `dro-grasp train` wrote")


def weights_names() -> list[str]:
    """Names of the shipped weights."""
    return sorted(file.stem for file in SHIPPED_FOLDER.glob("*.safetensors"))


def describe_weights(name: str | Path | None = None) -> dict[str, Any]:
    """Configuration, training and earlier trainings of a weights file, its size and its SHA-256."""
    path = locate_weights(name)
    entry, tensors = _read(path)
    return {
        "name": path.stem, "parameters": sum(t.numel() for t in tensors.values()), "bytes": path.stat().st_size,
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "config": entry.get("config", {}), "about": entry["about"],
        "history": entry["history"],
    }


def verify_weights(name: str | Path | None = None) -> str:
    """SHA-256 of a weights file, or of one of `SMALL`, that loads and, if it ships, is unchanged."""
    path = SHIPPED_FOLDER / f"{name}.safetensors" if name in SMALL else locate_weights(name)
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise WeightsError(f"{path} cannot be read ({error.strerror or error}); install the package again") from error
    if path.is_relative_to(SHIPPED_FOLDER):
        lines = (SHIPPED_FOLDER / CHECKSUMS).read_text().splitlines()
        expected = {file: known for known, file in (line.split() for line in lines)}
        shipped = expected.get(path.relative_to(SHIPPED_FOLDER).as_posix(), "none")
        if digest != shipped:
            raise WeightsError(f"{path} has SHA-256 {digest}, shipped was {shipped}; install the package again")
    if name not in SMALL:
        load_weights(path)
    return digest


def _read(path: Path) -> tuple[dict[str, Any], Tensors]:
    with reading(path, WeightsError, "a weights file that is not cut short; copy or train it again"):
        with path.open("rb") as file:
            if file.read(2) in PICKLES:
                raise WeightsError(f"{path} is a pickled PyTorch file, which can run code and is refused; expected "
                                   "safetensors written by `dro-grasp train`")
        with safe_open(path, "pt") as file:
            text = (file.metadata() or {}).get(KEY)
            tensors = {key: file.get_tensor(key) for key in file.keys()}
        entry = None if text is None else json.loads(text)
    if not isinstance(entry, dict):
        raise WeightsError(f"{path} is a safetensors file, but not of dro-grasp; give a file that `dro-grasp train` wrote")
    if entry.get("format_version") != FORMAT_VERSION:
        raise WeightsError(f"{path} has weights version {entry.get('format_version')}, expected {FORMAT_VERSION}; use "
                           "weights made with this version")
    about, history = entry.setdefault("about", {}), entry.setdefault("history", [])
    if not (isinstance(entry.get("config", {}), dict) and isinstance(about, dict) and isinstance(history, list)
            and all(isinstance(each, dict) for each in history)):
        raise WeightsError(f"{path}: its configuration and 'about' must be objects, and 'history' a list of objects; train "
                           "again")
    return entry, tensors
