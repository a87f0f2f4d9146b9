"""The `dro-grasp` command: it parses and runs one command, and turns errors into messages and exit codes."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from dro_grasp._version import __version__
from dro_grasp.cli.benchmark import Benchmark
from dro_grasp.cli.clear import Clear
from dro_grasp.cli.dataset import Dataset, Synthesize
from dro_grasp.cli.evaluate import Evaluate
from dro_grasp.cli.export import Export
from dro_grasp.cli.generate import Generate
from dro_grasp.cli.hand import HandCommand
from dro_grasp.cli.listing import Hands, Objects, Weights
from dro_grasp.cli.onboard import Onboard
from dro_grasp.cli.robots import Plan, RobotCommand, Tabletop
from dro_grasp.cli.switches import in_switches, use_options_of
from dro_grasp.cli.train import Pretrain, Train
from dro_grasp.cli.view import Picture, Serve, View
from dro_grasp.errors import DroGraspError, OptionError
from dro_grasp.workers import keep_memory

DONE = 0  # Exit code of a command that succeeded
FAILED = 1  # Exit code after a fault of dro-grasp, or when nobody reads the output any more, as in `dro-grasp hands | head -1`
BAD_INPUT = 2  # Exit code after invalid input
WAIT_POLICY = ("OMP_WAIT_POLICY", "PASSIVE")
"""Environment variable that lets PyTorch's threads sleep while they wait; otherwise they spin, which slows down everything on
a busy machine. It counts if it is set before PyTorch is loaded."""
THREADS = "OMP_NUM_THREADS"  # Environment variable of the number of threads, for which the same holds

named = tyro.conf.subcommand
Command = (
    Annotated[Generate, named("generate")]
    | Annotated[Evaluate, named("evaluate")]
    | Annotated[Export, named("export")]
    | Annotated[Benchmark, named("benchmark")]
    | Annotated[Onboard, named("onboard")]
    | Annotated[Synthesize, named("synthesize")]
    | Annotated[Dataset, named("dataset")]
    | Annotated[Pretrain, named("pretrain")]
    | Annotated[Train, named("train")]
    | Annotated[View, named("view")]
    | Annotated[Serve, named("serve")]
    | Annotated[Picture, named("picture")]
    | Annotated[HandCommand, named("hand")]
    | Annotated[Hands, named("hands")]
    | Annotated[Objects, named("objects")]
    | Annotated[Plan, named("plan")]
    | Annotated[Tabletop, named("tabletop")]
    | Annotated[Clear, named("clear")]
    | Annotated[RobotCommand, named("robot")]
    | Annotated[Weights, named("weights")]
)
"""Every command of the tool."""


def parse(arguments: Sequence[str]) -> Any:
    """Parse the arguments into a command; of a group such as `dataset`, the one in it.

    Raises:
        SystemExit: With code 2 after a message about invalid arguments, with code 0 after `--help`.
    """
    command = tyro.cli(
        Command,  # type: ignore[arg-type]
        prog="dro-grasp",
        description="Any robot hand description in, simulation-checked dexterous grasps out. "
        "--version prints the version. At any place, --verbose shows tracebacks, and --threads N computes in N threads "
        "(default: one for each core).",
        args=list(arguments),
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes),
    )
    return getattr(command, "command", command)


def without_threads(arguments: Sequence[str]) -> list[str]:
    """The arguments without `--threads N`, which is set for this process and those that it starts."""
    rest = [word for argument in arguments for word in argument.split("=", int(argument.startswith("--threads=")))]
    if "--threads" in rest:
        place = rest.index("--threads")
        number = "".join(rest[place + 1 : place + 2])
        if not (number.isdecimal() and int(number) > 0):
            raise OptionError(f"--threads is '{number}'; give a number of threads from 1 on")
        os.environ[THREADS] = number
        del rest[place : place + 2]
    return rest


def run(arguments: Sequence[str]) -> int:
    """Run one command, and return its exit code, unless it raises."""
    try:
        if arguments in (["--version"], ["-V"]):
            print(f"dro-grasp {__version__}")
            return DONE
        command = parse(without_threads(arguments))
        use_options_of(command, arguments)
        return command.run()
    finally:
        print(end="", flush=True)  # what nobody reads fails here rather than while Python ends


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command, and return its exit code: 0 for success, 2 for invalid input, 1 for an internal error."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    verbose = "--verbose" in arguments
    arguments = [a for a in arguments if a != "--verbose"] or ["--help"]
    os.environ.setdefault(*WAIT_POLICY)
    keep_memory()
    try:
        return run(arguments)
    except BrokenPipeError:  # as in `| head`; rich ends its own output in the same way
        sys.stdout = None  # type: ignore[assignment]
        return FAILED
    except DroGraspError as error:
        if verbose:
            traceback.print_exc()
        print(f"error: {in_switches(str(error))}", file=sys.stderr)
        return BAD_INPUT
    except Exception as error:  # the end of the program: whatever gets here is a fault of ours, and told as one
        if verbose:
            traceback.print_exc()
        else:
            print(f"internal error: {type(error).__name__}: {error}\nThis is a bug in dro-grasp, not in your input. "
                  "Run again with --verbose and report the traceback.", file=sys.stderr)
        return FAILED
    finally:
        use_options_of(None)
