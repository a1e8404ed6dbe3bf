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
from pathlib import Path

from ..errors import BAD_INPUT, BUSY, BusyError, InputError, input_errors
from ..version import __version__

COMMANDS = {  # each a module here with `main(args)`, imported when it runs; what it does
    "train": "train a policy (start here)",
    "evaluate": "success rate of a trained run, with confidence intervals",
    "hand": "write the file of a hand from its model, with a grasp",
    "env": "describe an environment: its observations, actions and taxels",
    "design": "where a hand's few taxels should go, before training",
    "doctor": "check which taxels fire during scripted grasps",
    "probe": "how well a layout's readings predict whether a grasp holds",
    "gate": "whether touch can make a difference in a scene, before training",
    "render": "draw a grasp with its taxels, or film a trained run",
    "view": "watch a hand or a trained run in MuJoCo's viewer",
    "study": "train many runs from one file and compare them in a report",
}
LONGEST = 600  # characters of an error's line: a path may have 5,000


def main(args: Sequence[str] | None = None) -> int:
    """Run one command; the exit code: 0 done, 1 stopped or failed a check, 2 bad input, 75
    another process writes there."""
    for name in (
        "stdout",
        "stderr",
    ):  # one that was closed takes everything and shows nothing
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
    for stream in (
        sys.stdout,
        sys.stderr,
    ):  # a terminal that cannot show a character shows "?"
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        try:
            code = _run(list(sys.argv[1:] if args is None else args))
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # who read our output has gone, such as `head`
        code, nowhere = 1, os.open(os.devnull, os.O_WRONLY)
        for stream in (
            sys.stdout,
            sys.stderr,
        ):  # nothing more can be written, not even at the end
            os.dup2(nowhere, stream.fileno())
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
        lines = ["usage: tactilerl COMMAND [OPTIONS]", "", "commands:"]
        lines += [f"  {name:10}{about}" for name, about in COMMANDS.items()]
        lines += [
            "",
            "--import MODULE, with any command, imports a module of your own first.",
        ]
        lines += ["", "tactilerl COMMAND --help lists a command's options."]
        print("\n".join(lines))
        return 0 if args else 2
    if args[0] == "--version":
        print(f"tactilerl {__version__}")
        return 0
    name, rest = args[0], args[1:]
    try:
        if odd := next((arg for arg in args if "\0" in arg), None):
            raise InputError(f"found {odd[:50]!r}, allowed no character 0")
        _import(first.modules)
        if name not in COMMANDS:
            from ..envs.validation import nearest

            hint = nearest(name, COMMANDS)
            raise InputError(
                f"unknown command {name!r}; {hint}allowed: {', '.join(COMMANDS)}"
            )
        code: int = import_module(f".{name}", __package__).main(rest)
        return code
    except InputError as error:
        from ..algos import mpi

        if mpi.launched_rank() not in (None, "0"):
            time.sleep(
                1.0
            )  # mostly rank 0 has found the same, and its end is the others'
        _say("error", error, rest)
        return BUSY if isinstance(error, BusyError) else BAD_INPUT
    except BrokenPipeError:
        raise
    except (
        FloatingPointError,
        OSError,
    ) as error:  # DivergenceError, without importing PyTorch for it
        _say("stopped", error)
        return 1
    except KeyboardInterrupt as error:
        _say("interrupted", error)
        return 130
    except Exception as error:
        where = {
            Path(frame.filename).parent.name
            for frame in traceback.extract_tb(error.__traceback__)
        }
        chosen = os.environ.get("MUJOCO_GL")
        if (
            not chosen or "mujoco" in sys.modules or "mujoco" not in where
        ):  # something else is to blame
            raise
        found = f"MUJOCO_GL: found {chosen!r}, which does not work here ({error})"
        cure = "install its library (Debian: libosmesa6, libegl1), or unset it where nothing is drawn"
        _say("error", InputError(f"{found}; {cure}"))
        return 2


def _import(modules: Sequence[str]) -> None:
    if modules:
        from ..envs import plugins

        with input_errors():
            plugins.import_modules(modules)


def _say(what: str, error: BaseException, args: Sequence[str] = ()) -> None:
    """One line about the end of a command: the error, and what was noted on its way here."""
    reason = _as_typed(str(error), args)
    said = [f"{what}: {reason}" if reason else what, *getattr(error, "__notes__", ())]
    line = " ".join("; ".join(said).split())
    if len(line) > LONGEST:
        line = f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"
    print(f"tactilerl: {line}", file=sys.stderr)


def _as_typed(line: str, args: Sequence[str]) -> str:
    """What is wrong with a field, named as the flag that set it."""
    field, colon, rest = line.partition(":")
    for arg in args:
        flag = arg.partition("=")[0]
        name = flag.removeprefix("--").replace("-", "_")
        if flag != name and field.removeprefix("--").replace("-", "_") == name:
            return f"{flag}{colon}{rest}"
    return line
