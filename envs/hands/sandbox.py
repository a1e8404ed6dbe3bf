"""Anybody's own hand, read in a process of its own: a model may hang, crash or fill the memory.

What comes back is the hand, or one line. Only then is its model compiled in this process. A hand is
read once, as long as its files stay as they are.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

from .files import KEPT
from .hand import Hand

CPU_SECONDS, SECONDS = 30, 300
"""Of reading: on a processor, and by the clock, which counts where a file is waited for."""
MEMORY = 8 * 2**30  # bytes of address space
ASKED, RESULT = "asked", "result"
TRIED = "TACTILERL_HANDS_TRIED"
"""Environment variable: what has been read well, for processes that are started from here."""
MOST_TRIED = (
    60_000  # characters of that: Linux starts no process with a variable of 128 KiB
)
KINDS: dict[str, type[Exception]] = {
    kind.__name__: kind
    for kind in (ValueError, FileNotFoundError, ImportError, OSError)
}
_read: dict[Path, tuple[str, Hand]] = {}
_lock = threading.Lock()


def load(path: Path) -> Hand:
    """The hand of a file; raises as `loading.load`, and ValueError where reading it takes too long or
    too much memory, or breaks MuJoCo."""
    whole = path.absolute()
    with _lock:
        state, hand = _read.get(whole, ("", None))
        if hand is None or state != _state(whole, *hand.build.files):
            hand = _load(path, whole)
            _read[whole] = _state(whole, *hand.build.files), hand
        return hand


def describe(model: str, folder: Path, said: dict[str, Any]) -> tuple[str, list[str]]:
    """The text of a hand's file for a model, and notes; raises as `describing.describe`."""
    found: tuple[str, list[str]] = _ask(
        "describe", model, (model, folder.absolute(), said), folder
    )
    return found


def _state(*files: Path) -> str:
    """Changes when one of the files does, or a grasp is kept beside the first."""
    found = []
    for path in (*files, files[0].with_suffix(KEPT)):
        look = path.stat() if path.exists() else None
        found.append((str(path), look and look.st_size, look and look.st_mtime_ns))
    return json.dumps(found)


def _load(path: Path, whole: Path) -> Hand:
    """In a process of its own, unless one that started this has done so."""
    tried = list(filter(None, os.environ.get(TRIED, "").split("\n")))
    if any(_is_as_before(state, whole) for state in tried):
        from . import loading

        return loading.load(whole)
    hand: Hand = _ask("load", f"hand file {path}", (whole,), path.parent)
    kept = [state for state in tried if json.loads(state)[0][0] != str(whole)]
    kept.append(_state(whole, *hand.build.files))
    while (
        sum(map(len, kept)) > MOST_TRIED
    ):  # what is forgotten is only read in a process again
        kept.pop(0)
    os.environ[TRIED] = "\n".join(kept)
    return hand


def _is_as_before(state: str, whole: Path) -> bool:
    """Is the state that of this file, and of those of its model as they are now?"""
    *files, _ = (Path(path) for path, *_ in json.loads(state))
    return files[0] == whole and _state(*files) == state


def _ask(job: str, what: str, args: tuple[Any, ...], beside: Path) -> Any:
    """What a job says in a process of its own; its last words name files as they were asked for."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, ASKED).write_bytes(pickle.dumps((job, what, args, CPU_SECONDS)))
        _run(what, folder)
        kind, result = pickle.loads(Path(folder, RESULT).read_bytes())
    if kind:
        asked = "" if beside == Path() else f"{beside}/"
        raise KINDS[kind](result.replace(f"{beside.absolute()}/", asked))
    return result


def _run(what: str, folder: str) -> None:
    """Have the result written there; ValueError where there is none."""
    command = [sys.executable, "-c", f"from {__name__} import main; main()"]
    search = os.pathsep.join(os.path.abspath(place) for place in sys.path)
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    silent: Any = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    there: Any = {"cwd": folder, "env": {**os.environ, **threads, "PYTHONPATH": search}}
    try:
        code = subprocess.run(
            command,
            timeout=SECONDS,
            start_new_session=True,
            check=False,
            **there,
            **silent,
        ).returncode
    except subprocess.TimeoutExpired:
        code = -signal.SIGXCPU
    if not Path(folder, RESULT).exists():
        how = f"ends its reader (code {code})"
        if code in (-signal.SIGXCPU, -signal.SIGKILL):
            how = f"takes longer than {CPU_SECONDS} s to read"
        elif code < 0:
            how = f"breaks MuJoCo's reader ({signal.Signals(-code).name})"
        raise ValueError(
            f"{what}: the model {how}; make it smaller, or drop what is no hand"
        )


def main() -> None:
    """The child: writes a pickle of "" and the result, or of the kind and the line of an error."""
    from . import describing, loading

    job, what, args, seconds = pickle.loads(Path(ASKED).read_bytes())
    with contextlib.suppress(
        ImportError, ValueError, OSError
    ):  # where there are such limits
        import resource

        for limit, value in (("AS", MEMORY), ("CPU", seconds), ("CORE", 0)):
            resource.setrlimit(getattr(resource, f"RLIMIT_{limit}"), (value, value))
    result: tuple[str, Any]
    try:
        jobs: dict[str, Any] = {"load": loading.load, "describe": describing.describe}
        result = "", jobs[job](*args)
    except tuple(KINDS.values()) as error:
        kind = next(name for name, kind in KINDS.items() if isinstance(error, kind))
        result = kind, str(error)
    except MemoryError:
        result = (
            "ValueError",
            f"{what}: the model needs more than {MEMORY >> 30} GB to read",
        )
    except Exception as error:  # whatever MuJoCo or a parser raises
        line = " ".join(str(error).split())[:300]
        result = "ValueError", f"{what}: model: {type(error).__name__}: {line}"
    Path(RESULT).write_bytes(pickle.dumps(result))
