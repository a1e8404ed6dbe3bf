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

from .hand import Hand

CPU_SECONDS, SECONDS = 30, 300
"""Of reading: on a processor, and by the clock, which counts where a file is waited for."""
MEMORY = 8 * 2**30  # bytes of address space
RESULT = "result"
TRIED = "TACTILERL_HANDS_TRIED"
"""Environment variable: what has been read well, for processes that are started from here."""
KINDS: dict[str, type[Exception]] = {
    kind.__name__: kind for kind in (ValueError, FileNotFoundError, ImportError, OSError)
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


def _state(*files: Path) -> str:
    """Changes when one of the files does; "" where one cannot be looked at."""
    with contextlib.suppress(OSError):
        looks = [(str(path), path.stat()) for path in files]
        return json.dumps([(path, look.st_size, look.st_mtime_ns) for path, look in looks])
    return ""


def _load(path: Path, whole: Path) -> Hand:
    """In a process of its own, unless one that started this has done so; its last words name the file
    as it was asked for."""
    state, tried = _state(whole), os.environ.get(TRIED, "").split("\n")
    if state and state in tried:
        from . import loading

        return loading.load(whole)
    with tempfile.TemporaryDirectory() as folder:
        _run(path, whole, folder)
        kind, result = pickle.loads(Path(folder, RESULT).read_bytes())
    if kind:
        beside = "" if path.parent == Path() else f"{path.parent}/"
        raise KINDS[kind](result.replace(f"{whole.parent}/", beside))
    os.environ[TRIED] = "\n".join([*tried, state])
    return result  # type: ignore[no-any-return]


def _run(path: Path, whole: Path, folder: str) -> None:
    """Have the result written there; ValueError where there is none."""
    command = f"from {__name__} import main; main()"
    search = os.pathsep.join(os.path.abspath(place) for place in sys.path)
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    silent: Any = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    process = subprocess.Popen(
        [sys.executable, "-c", command, str(whole), str(CPU_SECONDS)],
        cwd=folder,
        env={**os.environ, **threads, "PYTHONPATH": search},
        start_new_session=True,
        **silent,
    )
    try:
        code = process.wait(SECONDS)
    except subprocess.TimeoutExpired:
        code = -signal.SIGXCPU
    finally:
        process.kill()
        process.wait()
    if not Path(folder, RESULT).exists():
        how = f"ends its reader (code {code})"
        if code in (-signal.SIGXCPU, -signal.SIGKILL):
            how = f"takes longer than {CPU_SECONDS} s to read"
        elif code < 0:
            how = f"breaks MuJoCo's reader ({signal.Signals(-code).name})"
        raise ValueError(f"hand file {path}: the model {how}; make it smaller, or drop what is no hand")


def main() -> None:
    """The child: writes a pickle of "" and the hand, or of the kind and the line of an error."""
    from . import loading

    path, seconds = Path(sys.argv[1]), int(sys.argv[2])
    result: tuple[str, Any]
    with contextlib.suppress(ImportError, ValueError, OSError):  # where there are such limits
        import resource

        for limit, value in (("AS", MEMORY), ("CPU", seconds), ("CORE", 0)):
            resource.setrlimit(getattr(resource, f"RLIMIT_{limit}"), (value, value))
    try:
        result = "", loading.load(path)
    except tuple(KINDS.values()) as error:
        kind = next(name for name, kind in KINDS.items() if isinstance(error, kind))
        result = kind, str(error)
    except MemoryError:
        result = "ValueError", f"hand file {path}: the model needs more than {MEMORY >> 30} GB to read"
    except Exception as error:  # whatever MuJoCo or a parser raises
        line = " ".join(str(error).split())[:300]
        result = "ValueError", f"hand file {path}: model: {type(error).__name__}: {line}"
    Path(RESULT).write_bytes(pickle.dumps(result))
