"""Files of anybody, read within limits; files of ours, written whole or not at all."""

from __future__ import annotations

import errno
import json
import os
import platform
import re
import secrets
import shlex
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from gzip import GzipFile
from pathlib import Path
from typing import Any, BinaryIO

import filelock

from .errors import BusyError, InputError

MAX_BYTES = 10**9  # bytes of a file that is read as a whole
MAX_RECORD = (
    3 * 10**7
)  # of a JSON or CSV file, which takes fifty times that when it is parsed
NAME = re.compile(r"[A-Za-z0-9][\w.+-]*")
LONGEST_NAME = 240  # bytes; file systems allow 255, endings included
LOCK_WAIT = 2.0  # s; who only looks at a lock has it for an instant
LEFTOVER = ".tmp"  # ends the name of what a process left that was killed while it wrote
# Not the fault of who named the file.
DISK_ERRORS = errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG


@contextmanager
def damage_named(
    path: Path, problem: str = "damaged", missing: str = ""
) -> Iterator[None]:
    """Turn any error from a file's content into an InputError that names the file and the `problem`.

    Where there is no file it is a FileNotFoundError, or an InputError that says `missing`.
    """
    try:
        yield
    except FileNotFoundError:
        if not missing:
            raise
        raise InputError(missing) from None
    except InputError as error:
        if str(path) in str(error):
            raise
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # parsers answer garbage with errors of any kind
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())[:200]
        raise InputError(
            f"{path}: {problem} ({reason or type(error).__name__})"
        ) from error


def open_regular(path: Path) -> BinaryIO:
    """Open a file to read; ValueError for a pipe or a device, which may have no end."""
    if os.path.exists(path) and not os.path.isfile(path):
        raise ValueError("not a regular file")
    return open(path, "rb")


def read_whole(path: Path, most: int = MAX_BYTES, is_packed: bool = False) -> bytes:
    """Return all that a file holds, or a gzip file where it `is_packed`.

    Raise ValueError where that is more than `most` bytes.
    """
    with open_regular(path) as file:
        data = (GzipFile(fileobj=file) if is_packed else file).read(most + 1)
    if len(data) > most:
        raise ValueError(f"it holds more than {most:,} bytes")
    return data


def require_path(path: Any, where: str) -> Path:
    """Return a path that somebody gave; InputError where it is none, or empty."""
    if not isinstance(path, str | os.PathLike) or not str(path):
        raise InputError(f"{where}: found {path!r}, allowed a path")
    return Path(path)


def as_json(data: Any) -> bytes:
    """Return values as the content of a JSON file."""
    return (json.dumps(data, indent=1) + "\n").encode()


def require_new(path: Path, overwrite: bool = False, ending: str = "") -> None:
    """Raise InputError where something is at `path` that a command may not replace.

    That is anything but an empty folder, unless it may `overwrite`; a link or a device in any case.
    A name has to have the `ending`.
    """
    if not path.name.endswith(ending):
        raise InputError(
            f"found {path.name!r} as a new file, allowed names that end in {ending}"
        )
    with writable(path):
        is_folder = path.is_dir() and not path.is_symlink()
        is_there = any(path.iterdir()) if is_folder else os.path.lexists(path)
    if is_there and not overwrite:
        raise InputError(
            f"cannot write {str(path)!r}: it is there already; choose another name, or "
            "replace it with --overwrite"
        )
    if not is_folder:
        require_file(path)


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Give a file to write to that takes the place of `path` when it is whole, or not at all.

    It is made under a name that nobody knows, so that no link is followed. InputError where a link,
    a folder or a device is at `path`, or nothing can be written; OSError where the disk is full.
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
    """Raise InputError where something else than a regular file is at `path`."""
    with writable(path):
        is_there = os.path.lexists(path)
    if is_there and (path.is_symlink() or not path.is_file()):
        raise InputError(
            f"cannot write {str(path)!r}: it is a link or no file, allowed a file or a new name"
        )


def make_folder(path: Path) -> None:
    """Make a folder in one of ours if it is missing; InputError for a link or a file."""
    with writable(path):
        path.mkdir(exist_ok=True)
    if path.is_symlink():
        raise InputError(f"cannot write into {str(path)!r}: it is a link")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes from writing to a folder, made where there is none.

    Raise BusyError naming the process that holds it. The system releases the lock when the process
    ends, however it ends. What a process left that was killed while it wrote is dropped. A
    folder that turns out to be refused keeps no new lock.
    """
    path = folder / ".lock"
    try:
        with ExitStack() as held:
            with writable(path):
                is_new = not path.exists()
                folder.mkdir(parents=True, exist_ok=True)
                held.enter_context(filelock.FileLock(path, timeout=LOCK_WAIT))
                with open(path, "w", encoding="utf-8", opener=no_link) as file:
                    file.write(f"process {os.getpid()} on {platform.node()}")
            left = "." + 16 * "[0-9a-f]" + LEFTOVER
            for path_left in (*folder.glob(left), *folder.glob(f"experience/{left}")):
                path_left.unlink(missing_ok=True)
            try:
                yield
            except InputError:
                if is_new:
                    path.unlink(missing_ok=True)
                raise
    except filelock.Timeout:
        holder = path.read_text(encoding="utf-8", errors="replace")[:200]
        raise BusyError(f"{folder}: {holder} is writing to this folder") from None


@contextmanager
def writable(path: Path) -> Iterator[None]:
    """Raise InputError where a place cannot be written to; a full disk stays an OSError."""
    try:
        yield
    except OSError as error:
        if error.errno in (None, *DISK_ERRORS):  # None: of a lock that another holds
            raise
        raise InputError(f"cannot write {str(path)!r}: {error.strerror}") from error


def no_link(name: str, flags: int) -> int:
    """Open a file to write in place, but no link: an `opener` for `open`."""
    return os.open(name, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


def require_name(name: Any, where: str) -> Any:
    """Return a name that files are called by.

    Raise InputError where it could lead out of a folder, is no text, or is too long.
    """
    is_name = isinstance(name, str) and NAME.fullmatch(name)
    if not is_name or len(name.encode()) > LONGEST_NAME:
        raise InputError(
            f"{where}: found {str(name)[:60]!r}, expected a word of letters, digits, '-', '_' and '.', "
            f"of up to {LONGEST_NAME} bytes, for files get this name"
        )
    return name


def pasted(path: Path | str) -> str:
    """Return a path as it can be pasted into a shell behind a command."""
    return shlex.quote(f"./{path}" if str(path).startswith("-") else str(path))
