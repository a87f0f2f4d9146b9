"""Files of the user: paths are checked before the work and quoted for shells, reading has one error, writing is whole."""

from __future__ import annotations

import difflib
import lzma
import os
import secrets
import shlex
import struct
import zlib
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import chain, count
from pathlib import Path
from pickle import UnpicklingError
from tokenize import TokenError
from zipfile import BadZipFile

from safetensors import SafetensorError

from dro_grasp.errors import DroGraspError, OptionError, OutputError

MAX_QUOTED_CHARS = 200  # Characters of a path or a reason that an error repeats (ours)
FRAME_FILE = {
    "frame": "the frame's name", "T_frame_camera": "the camera's pose in the frame, 4x4 [m]",
    "intrinsics": "the camera's pinhole matrix, 3x3 [pixels]", "depth_unit": "the metres of one count of a depth image",
    "T_frame_object": "the object's pose in the frame, 4x4 [m]"}
"""Entries of the files of cameras and frames, which may be one, and what each is."""
ELSEWHERE = {"k": "intrinsics", "camera_matrix": "intrinsics", "depth_scale": "depth_unit"}  # Names that other programs use
LIKE = 0.6  # Share of equal letters from which a word may stand for another (ours)
SAME = {".yaml": ".yml", ".html": ".htm"}  # Endings of file names, and others that mean the same
FOREIGN = (
    OSError, MemoryError, ValueError, LookupError, ArithmeticError, EOFError, RuntimeError, UnpicklingError, struct.error,
    zlib.error, lzma.LZMAError, BadZipFile, TokenError, SafetensorError)
"""What decoders raise over damaged or foreign bytes; JSON, Unicode and Arrow mostly raise ValueErrors,
NumPy a TokenError over the header of an array.

A TypeError, AttributeError or NameError is missing on purpose: in a decoder of ours it is our fault, and must be seen.
"""
UNTYPED = (TypeError, AttributeError)
"""What taking apart a tree of foreign values (JSON, pickles) raises too: an entry is of another type than it should be."""


def given_path(name: Path | str) -> Path:
    """The path that a user gives, with `~` expanded, whatever is there.

    It is an OptionError if it is too long, of a user who does not exist, or with characters that no file system takes.
    """
    try:
        path = Path(name).expanduser()
        os.fsencode(path).decode()
        with suppress(FileNotFoundError, NotADirectoryError, PermissionError):
            os.stat(path)
    except (OSError, ValueError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise OptionError(f"{str(name)[:MAX_QUOTED_CHARS]!r} is no path of a file ({reason}); check its spelling") from error
    return path


def require_known(values: Mapping[str, object], known: Mapping[str, str], origin: object) -> None:
    """Refuse entries of a file that nobody reads, by an OptionError that lists the known ones.

    It names a similar one that the file lacks, and says what that is; `known` has the entries and what each is.
    """
    for entry in values:
        if entry not in known:
            lacking = {name.lower(): name for name in known if name not in values}
            near = ([ELSEWHERE[entry.lower()]] if entry.lower() in ELSEWHERE
                    else difflib.get_close_matches(entry.lower(), lacking, n=1, cutoff=LIKE))
            meant = [lacking[name] for name in near if name in lacking]
            raise OptionError(f"{origin} has an entry '{entry}', which nothing reads; known are {', '.join(known)}. "
                              + (f"Call it '{meant[0]}' if it is {known[meant[0]]}; else leave it out" if meant
                                 else "Leave it out"))


def command(*words: object) -> str:
    """A command line that a shell splits into these words, for the user to run."""
    return shlex.join(map(str, words))


@contextmanager
def reading(path: object, refuse: type[DroGraspError], expected: str, *others: type[Exception]) -> Iterator[None]:
    """Turn what damaged or foreign bytes raise into one error that names the file; our own errors and our faults pass.

    Args:
        path: The file, or its name in words.
        refuse: Kind of the error.
        expected: What the file should be, in words.
        others: What the library behind this reader raises beside FOREIGN.
    """
    try:
        yield
    except DroGraspError:
        raise
    except (*FOREIGN, *others) as error:
        raise refuse(f"{path} cannot be read ({reason_of(error)}); expected {expected}") from error


def reason_of(error: Exception) -> str:
    """Why something failed, in one short line."""
    reason = getattr(error, "strerror", None) or next(iter(str(error).splitlines()), "") or type(error).__name__
    return reason[:MAX_QUOTED_CHARS]


def is_unread(error: BaseException | None) -> bool:
    """Whether an error, or the one that `reading` met, tells of disk or memory, and nothing of the file's content."""
    if isinstance(error, DroGraspError):
        error = error.__cause__
    # Arrow raises an OSError without a number over damaged content, PyTorch a RuntimeError where memory ends.
    return (isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno is not None)
            or (isinstance(error, RuntimeError) and "allocate memory" in str(error)))


def free_name(stem: str, taken: Container[str], ending: str = "", numbered: str = "-{}") -> str:
    """The name of a stem and an ending, or where it is taken the first one with a number, from 2 on, that is not."""
    names = chain([stem + ending], (stem + numbered.format(number) + ending for number in count(2)))
    return next(name for name in names if name not in taken)


def set_aside(path: Path, *beside: Path) -> Path:
    """Rename a damaged file, and those that belong to it, under one number, so that nothing is lost; returns its new path.

    Earlier ones keep their names: the next is `.damaged.2`.
    """
    endings = (".damaged" if number == 1 else f".damaged.{number}" for number in count(1))
    ending = next(e for e in endings if not any(p.with_name(p.name + e).exists() for p in (path, *beside)))
    for each in beside:
        if each.exists():
            each.replace(each.with_name(each.name + ending))
    return path.replace(path.with_name(path.name + ending))


def check_output(path: Path | str, *endings: str) -> Path:
    """Refuse a path of a file that cannot be written, by an OutputError, before any work is done.

    `endings` is what its name may end in, the usual one first, and what stands for these in SAME; anything by default.
    """
    path = given_path(path)
    parent = path.absolute().parent
    if not parent.is_dir():
        raise OutputError(f"cannot write {path}: no folder {parent}; create it first ({command('mkdir', '-p', parent)})")
    if path.is_dir():
        raise OutputError(f"cannot write {path}: it is a folder; give the name of a file in it")
    allowed = [each for ending in endings for each in (ending, SAME.get(ending)) if each]
    if endings and path.suffix.lower() not in allowed:
        raise OutputError(f"cannot write {path}: give a name that ends in {' or '.join(allowed)}, such as "
                          f"{path.with_suffix(endings[0]).name}")
    if path.exists() and not path.is_file():
        raise OutputError(f"cannot write {path}: it is a device or a pipe, which writing would replace; give a file's name")
    if not os.access(parent, os.W_OK) or (path.exists() and not os.access(path, os.W_OK)):
        raise OutputError(f"cannot write {path}: no permission; choose another path")
    return path


def require_distinct(**paths: Path | None) -> None:
    """Refuse outputs, by their options' names, of which two are one file, by an OutputError."""
    first: dict[Path, str] = {}
    for name, path in paths.items():
        if path is not None and (other := first.setdefault(given_path(path).resolve(), name)) != name:
            raise OutputError(f"{path} is named twice, and one file would replace the other; give each a file of its own "
                              f"({other}=..., {name}=...)")


def check_folder(path: Path | str) -> Path:
    """Refuse a folder that is or lies in a file, or may not be written to, by an OutputError; nothing is created."""
    path = given_path(path)
    there = next(place for place in (path.absolute(), *path.absolute().parents) if place.exists())
    if not there.is_dir():
        raise OutputError(f"cannot write into {path}: {there} is a file; give a folder")
    if not os.access(there, os.W_OK):
        raise OutputError(f"cannot write into {there}: no permission; choose another folder")
    return path


def make_folder(path: Path | str) -> Path:
    """Create a folder to write to, with its parents, unless it exists; see `check_folder`."""
    path = check_folder(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot create {path}: {error.strerror}; choose another folder") from error
    return path


@contextmanager
def replacing(path: Path | str, what: str = "") -> Iterator[Path]:
    """A temporary path that replaces `path` when the block ends.

    A failure leaves `path` as it was; its OutputError names `what`. Of a link, the target is replaced.
    """
    path, temporary = given_path(path), None
    try:
        place = Path(os.path.realpath(path))
        unused = place.parent / f".{place.name}{secrets.token_hex(4)}.part"
        handle = os.open(unused, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)  # less what the user's umask takes
        temporary, mode = unused, os.fstat(handle).st_mode
        os.close(handle)
        yield temporary
        os.chmod(temporary, mode)  # a library may have put a new file there
        os.replace(temporary, place)
    except (OSError, SafetensorError) as error:
        reason = getattr(error, "strerror", None) or error
        target = f"{what} to {path}" if what else path
        raise OutputError(f"cannot write {target}: {reason}; free some space or choose another folder") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


@contextmanager
def locking(lock: Path, refuse: Callable[[], str]) -> Iterator[None]:
    """Hold a lock while the block lasts, where the file system has locks.

    While another process holds it, there is an OutputError with the message that `refuse` returns.
    """
    from filelock import FileLock, Timeout  # takes longer to import than all else here

    own = FileLock(lock, timeout=0, fallback_to_soft=False)
    try:
        own.acquire()
    except Timeout as error:
        raise OutputError(refuse()) from error
    except OSError:
        pass  # a file system without locks
    try:
        yield
    finally:
        own.release()
