"""The command `tactilerl`: reads flags, calls the part that does the work, reports errors."""

from __future__ import annotations

import argparse
import io
import os
import sys
import time
import traceback
from collections.abc import Sequence
from importlib import import_module

from ..errors import BAD_INPUT, BUSY, BusyError, InputError, input_errors
from ..version import __version__

COMMANDS = {  # each a module here with `main(args)`, imported when it runs
    "train": "train a policy (start here)",
    "evaluate": "play a trained policy: success rate with its confidence interval",
    "render": "draw a grasp with its taxels, or film a trained run",
    "export": "write a trained policy as an ONNX graph, for a real hand",
    "env": "describe an environment, and check which of its taxels can fire",
    "design": "choose where a hand's few taxels should go, before training",
    "gate": "check with scripted hands whether touch can help in a scene",
    "hand": "write the file of a hand from its model, with a grasp",
    "study": "train many runs from one file and compare them in a report",
}


def main(args: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    0: done, 1: stopped or failed a check, 2: bad input, 75: another process writes
    there, 130: interrupted.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # shows "?" for what it cannot show
            stream.reconfigure(errors="replace")
    try:
        code = _run(list(sys.argv[1:] if args is None else args))
        print(end="", flush=True)
    except SystemExit as stop:  # of tyro, which has said why
        code = int(stop.code or 0)
    except InputError as error:
        code = _refuse(error)
    except BrokenPipeError:  # whoever read our output has gone, such as `head`
        code, nowhere = 1, os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(nowhere, stream.fileno())
    except (
        FloatingPointError,
        OSError,
        MemoryError,
    ) as error:  # such as DivergenceError
        _say("stopped", error)
        code = 1
    except KeyboardInterrupt as error:
        _say("interrupted", error)
        code = 130
    except Exception:
        traceback.print_exc()
        code = 1
    if code and "mpi4py" in sys.modules:
        from ..algos import mpi

        mpi.abort(code)
    return code


def _run(args: list[str]) -> int:
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument(
        "--import", dest="modules", action="append", default=[], nargs="?", const=""
    )
    first, args = parser.parse_known_args(args)
    if not args or args[0] in ("-h", "--help"):
        _help()
        return 0 if args else BAD_INPUT
    name, *args = args
    if name == "--version":
        print(f"tactilerl {__version__}")
        return 0
    if name not in COMMANDS:
        raise InputError(f"unknown command {name!r}, allowed: {', '.join(COMMANDS)}")
    with input_errors():
        if first.modules:
            from ..envs import plugins

            plugins.import_modules(first.modules)
        command = import_module(f".{name}", __package__)
    return int(command.main(args))


def _refuse(error: InputError) -> int:
    """Say what was wrong with the input; return the exit code."""
    from ..algos import mpi

    if mpi.launched_rank() not in (None, "0"):
        time.sleep(1.0)  # mostly rank 0 has found the same, and ends the others
    _say("error", error)
    plugins = sys.modules.get("tactilerl.envs.plugins")
    if plugins and plugins.module_of(error):  # of --import
        traceback.print_exception(error)
    return BUSY if isinstance(error, BusyError) else BAD_INPUT


def _help() -> None:
    """Print the list of commands."""
    about = [f"  {name:10}{text}" for name, text in COMMANDS.items()]
    print("usage: tactilerl COMMAND [OPTIONS]", "", "commands:", *about, "", sep="\n")
    print("--import MODULE, with any command, imports a module of your own first.\n")
    print("tactilerl COMMAND --help lists a command's options.")


def _say(what: str, error: BaseException | str) -> None:
    """Print one line about the end of a command: the error, and what was noted on its way."""
    parts = [f"{what}: {error}" if str(error) else what]
    parts += getattr(error, "__notes__", ())
    line = " ".join("; ".join(parts).split())
    print(f"tactilerl: {line}", file=sys.stderr)
