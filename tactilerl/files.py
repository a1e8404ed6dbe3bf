"""Files: damage said in one line, and files of ours written whole or not at all."""

from __future__ import annotations

import json
import os
import platform
import re
import secrets
import shlex
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import filelock

from .errors import BusyError, InputError

NAME = re.compile(r"[A-Za-z0-9][\w.+-]*")
LOCK_WAIT = 2.0  # s; who only looks at a lock has it for an instant
LEFTOVER = ".tmp"  # ends the name of what a process left that was killed while it wrote


@contextmanager
def damage_named(
    path: Path, problem: str = "damaged", missing: str = ""
) -> Iterator[None]:
    """Turn any error from a file's content into an InputError that names the file and the `problem`.

    Where there is no file it is a FileNotFoundError, or an InputError that says
    `missing`.
    """
    try:
        yield
    except (FileNotFoundError, NotADirectoryError):
        if not missing:
            raise
        raise InputError(missing) from None
    except InputError as error:
        if str(path) in str(error):
            raise
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # parsers answer garbage with errors of any kind
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"{path}: {problem} ({reason})") from error


def require_path(path: Any, where: str) -> Path:
    """Return a path that somebody gave; InputError where it is none, or empty."""
    if not isinstance(path, str | os.PathLike) or not str(path):
        raise InputError(f"{where}: found {path!r}, allowed a path")
    return Path(path)


def as_json(data: Any) -> bytes:
    """Return values as the content of a JSON file."""
    return (json.dumps(data, indent=1) + "\n").encode()


def require_new(path: Path, overwrite: bool = False, *endings: str) -> None:
    """Raise InputError where something is at `path` that a command may not replace.

    That is anything but an empty folder, unless it may `overwrite`. A name has to have
    one of the `endings`, where there are some; "" is a folder's, which is made with
    those above it.
    """
    if endings and path.suffix not in endings:
        allowed = " or ".join(f"*{end}" if end else "a folder" for end in endings)
        raise InputError(f"found {path.name!r} as a new file, allowed {allowed}")
    if endings and path.suffix and not path.parent.is_dir():
        raise InputError(f"found no folder {str(path.parent)!r} for {path.name}")
    is_folder = os.path.isdir(path)
    with writable(path):
        is_there = any(os.scandir(path)) if is_folder else os.path.exists(path)
    above = path.absolute().parents
    folder = next(one for one in (path, *above) if os.path.isdir(one))
    if not os.access(folder, os.W_OK):
        raise InputError(f"cannot write {str(path)!r}: {str(folder)!r} is read-only")
    if is_there and not overwrite:
        raise InputError(
            f"cannot write {str(path)!r}: it is there already; choose another name, or "
            "replace it with --overwrite"
        )
    if not is_folder:
        require_file(path)


@contextmanager
def kept(path: Path) -> Iterator[None]:
    """Put back the file that was at `path`, if any, where what is done inside fails."""
    before = path.read_bytes() if path.is_file() else None
    try:
        yield
    except BaseException:
        if before is not None:
            path.write_bytes(before)
        raise


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Give a file to write to that takes the place of `path` when it is whole, or not at all.

    InputError where a folder or a device is at `path`, or nothing can be written;
    OSError where the disk is full.
    """
    require_file(path)
    temporary = path.with_name(f".{secrets.token_hex(8)}{LEFTOVER}")
    with writable(path):
        file = temporary.open("x+b")
    try:
        with file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        with writable(path):
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def require_file(path: Path) -> None:
    """Raise InputError where something else than a file is at `path`."""
    if os.path.exists(path) and not os.path.isfile(path):
        raise InputError(f"cannot write {str(path)!r}: it is no file")


def make_folder(path: Path) -> None:
    """Make a folder in one of ours if it is missing."""
    with writable(path):
        path.mkdir(exist_ok=True)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes from writing to a folder, made where there is none.

    Raise BusyError naming the process that holds it. The system releases the lock when
    the process ends, however it ends. What a process left that was killed while it
    wrote is dropped.
    """
    path = folder / ".lock"
    try:
        with ExitStack() as held:
            with writable(path):
                folder.mkdir(parents=True, exist_ok=True)
                held.enter_context(filelock.FileLock(path, timeout=LOCK_WAIT))
                path.write_text(f"process {os.getpid()} on {platform.node()}")
            for left in folder.rglob(f".*{LEFTOVER}"):
                left.unlink(missing_ok=True)
            yield
    except filelock.Timeout:
        holder = path.read_text(errors="replace")
        raise BusyError(f"{folder}: {holder} is writing to this folder") from None


@contextmanager
def writable(path: Path) -> Iterator[None]:
    """Raise InputError where a place cannot be written to."""
    try:
        yield
    except filelock.Timeout:
        raise
    except OSError as error:
        raise InputError(f"cannot write {str(path)!r}: {error.strerror}") from error


def require_name(name: Any, where: str) -> str:
    """Return a name that files are called by; InputError where it is none."""
    if not (isinstance(name, str) and NAME.fullmatch(name)):
        raise InputError(
            f"{where}: found {str(name)[:60]!r}, expected a word of letters, digits, '-', '_' and '.', "
            "for files get this name"
        )
    return name


def pasted(path: Path | str) -> str:
    """Return a path as it can be pasted into a shell behind a command."""
    return shlex.quote(f"./{path}" if str(path).startswith("-") else str(path))
