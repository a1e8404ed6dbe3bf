"""The command `tactilerl`: reads flags, calls the part that does the work, reports errors."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Sequence

from . import __version__
from .errors import InputError, let_rank_0_speak

COMMANDS = {
    "train": "train a policy (start here; --resume goes on with a run)",
    "evaluate": "success rate and return of a trained run, with confidence intervals",
    "env": "describe an environment: its observations, actions and taxels",
    "doctor": "do the taxels feel? scripted grasps, figures per layout",
    "probe": "what can a layout know? grasps played once, answers with intervals",
    "render": "a picture of a grasp with its taxels, or a film of a run",
}


def main(args: Sequence[str] | None = None) -> int:
    """Run one command; the exit code: 0 done, 1 stopped or failed a check, 2 bad input."""
    try:
        code = _run(list(sys.argv[1:] if args is None else args))
    except Exception:
        traceback.print_exc()
        code = 1
    if code and "mpi4py" in sys.modules:
        from .algos import mpi

        mpi.abort(code)
    return code


def _run(args: list[str]) -> int:
    if not args or args[0] in ("-h", "--help"):
        print(_usage())
        return 0 if args else 2
    if args[0] == "--version":
        print(f"tactilerl {__version__}")
        return 0
    name, rest = args[0], args[1:]
    try:
        if name not in COMMANDS:
            raise InputError(f"unknown command {name!r}; allowed: {', '.join(COMMANDS)}")
        return _command(name)(rest)
    except InputError as error:
        let_rank_0_speak()
        print(f"tactilerl: error: {error}", file=sys.stderr)
        return 2
    except FloatingPointError as error:  # DivergenceError, without importing PyTorch for it
        print(f"tactilerl: stopped: {error}; the last checkpoint is kept", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"tactilerl: stopped: {error}; the last checkpoint is kept", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("tactilerl: interrupted; the last checkpoint is kept", file=sys.stderr)
        return 130


def _usage() -> str:
    lines = ["usage: tactilerl COMMAND [OPTIONS]", "", "commands:"]
    lines += [f"  {name:10}{text}" for name, text in COMMANDS.items()]
    return "\n".join([*lines, "", "tactilerl COMMAND --help lists a command's options."])


def _command(name: str) -> Callable[[list[str]], int]:
    if name == "probe":
        from .probe.command import probe

        return probe
    from . import commands  # what a command needs is imported when it runs

    function: Callable[[list[str]], int] = getattr(commands, name)
    return function


if __name__ == "__main__":
    sys.exit(main())
