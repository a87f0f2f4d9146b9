"""`dro-grasp generate --server`: a grasp server, which has everything loaded, does the work of the command."""

from __future__ import annotations

import base64
import json
import os
import struct
import time
import uuid
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dro_grasp._version import __version__
from dro_grasp.cli.output import print_json, progress_bar, say_aside
from dro_grasp.cli.switches import in_switches
from dro_grasp.errors import OptionError, ServerError
from dro_grasp.files import FRAME_FILE, UNTYPED, check_output, given_path, reading, replacing, require_known

if TYPE_CHECKING:
    from dro_grasp.cli.generate import Generate

SERVER = "DRO_GRASP_SERVER"  # Environment variable of the server that is asked
HERE = "none"  # Address that stands for no server
TIMEOUT = 600.0  # Longest wait for a server [s] (ours); its own limit ends a request earlier
OWN = ("weights", "device")  # Options that are the server's own
SHOWN = ("picture", "view")  # Options that need the hand and the object here
SCENE = ("scene", "at", "pixel", "mask", "nearest", "part", "scene_picture")  # Options of scenes, which are taken apart here
SOURCES = ("auto", "network", "optimiser")  # What proposes candidates at a server, which runs no code of others
ANSWERED = {"warnings", "report", "seconds", "kept", "rows", "lines", "file"}  # What an answer to `POST /generate` holds
FAULT = 500  # Status of HTTP after a fault of dro-grasp


def server_of(given: str | None) -> str | None:
    """The address of the server that a command asks; None for none."""
    address = os.environ.get(SERVER) if given is None else given
    return None if address in {None, "", HERE} else address


def generate_at(address: str, command: Generate) -> int:
    """Do what the command does, with the work done by a server; neither PyTorch nor NumPy is loaded here."""
    begin = time.perf_counter()
    require_possible(command)
    output = None if command.output is None else check_output(command.output, ".parquet")
    call = call_of(command)
    start = time.perf_counter() - begin
    with progress_bar(f"asking {address}", command.json):
        answer = _answered(address, call)
    for line in answer["warnings"]:
        say_aside(in_switches(line))
    report, seconds, middle = answer["report"], answer["seconds"], time.perf_counter()
    if not answer["kept"]:
        command.say_that_none_is_left(report["object"], output, None)
    if output is not None:
        report["output"] = str(output)
        with replacing(output) as temporary:
            temporary.write_bytes(base64.b64decode(answer["file"]))
    now = time.perf_counter()
    seconds = {"start": start, **seconds, "files": now - middle, "total": now - begin}
    report["seconds"] = {part: round(value, 4) for part, value in seconds.items()}
    if command.json:
        print_json(report)
    else:
        command.show(report, answer["rows"], answer["lines"])
    return 0


def require_possible(command: Generate) -> None:
    """Refuse what a server cannot do: OptionError."""
    defaults = {field.name: field.default for field in (*fields(command), *fields(command.seen))}
    values = vars(command) | vars(command.seen)
    given = [name for name in (*OWN, *SHOWN, *SCENE) if values[name] != defaults[name]]
    if given:
        options = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        why = ("weights and device are those that the server was started with" if given[0] in OWN
               else "a scene is taken apart here; ask the server from Python, with choose=..." if given[0] in SCENE
               else "pictures and pages need hand and object here; draw the file with dro-grasp picture or view")
        raise OptionError(f"a grasp server cannot do {options}: {why}. Leave {options} out, or compute here (--server {HERE})")
    if command.source not in SOURCES:
        raise OptionError(f"--source is '{command.source}'; a grasp server takes {', '.join(SOURCES)}, and runs no code and "
                          f"reads no file of yours. Choose one of these, or compute here (--server {HERE})")
    if given_path(command.hand.partition("#")[0]).is_file():
        raise OptionError(f"--hand is the file {command.hand}; a grasp server knows hands by their names: start it with --hand "
                          f"{command.hand} and give the name, or compute here (--server {HERE})")
    assert command.object is not None  # there is one where there is no scene
    if given_path(command.object).is_dir():
        raise OptionError(f"--object is the folder {command.object}; a grasp server takes one object at a time. Give a file, "
                          f"or compute here (--server {HERE})")


def call_of(command: Generate) -> dict[str, Any]:
    """What the server is asked."""
    from dro_grasp.apps.server.client import sent_object

    assert command.object is not None
    file = given_path(command.object)
    sent = sent_object(file) if file.is_file() and file.suffix else {"name": command.object}
    same = ("hand", "num", "seed", "candidates", "refine", "temperature", "source", "least_confidence", "table", "mass",
            "protocol", "only_successful")
    return {
        **{name: getattr(command, name) for name in same}, **asdict(command.constraints),
        "object": sent | {"scale": command.scale, "keep_table": command.keep_table},
        "touch_table": None if command.touch_table is None else command.touch_table == "yes",
        "obstacles": None if command.obstacles is None else sent_object(command.obstacles) | {"scale": command.scale},
        "camera": None if command.camera is None else sent_camera(command.camera),
        "path": str(file.resolve()) if file.is_file() else None,
        "id": uuid.uuid4().hex,  # by which a busy server keeps its turn
    }


def sent_camera(path: Path) -> dict[str, Any]:
    """A camera's file as a request holds it, in single precision, as the command takes it; the server checks the rest."""
    key, path = "T_frame_camera", given_path(path)
    wanted = f'a file with {{"frame": NAME, "{key}": [4 rows of 4 numbers]}}, in metres'
    with reading(path, OptionError, wanted, *UNTYPED):
        values = json.loads(path.read_text(encoding="utf-8"))
        rows = [[struct.unpack("f", struct.pack("f", number))[0] for number in row] for row in values[key]]
        require_known(values, FRAME_FILE, path)
        return {"frame": values["frame"], key: rows}


def _answered(address: str, call: dict[str, Any]) -> dict[str, Any]:
    from dro_grasp.apps.server.client import GraspClient
    from dro_grasp.cli.view import TOKEN

    try:
        answer = GraspClient(address, os.environ.get(TOKEN), TIMEOUT).ask("POST", "/generate", call)
        if not isinstance(answer, dict) or not ANSWERED <= answer.keys():
            raise ServerError(f"{address} answers, but not as a grasp server of version {__version__}; start one with "
                              f"`dro-grasp serve`, or compute here (--server {HERE})")
        return answer
    except ServerError as error:
        if error.status == FAULT:  # the command tells a fault of dro-grasp as such, wherever it is
            raise RuntimeError(str(error)) from error
        raise
