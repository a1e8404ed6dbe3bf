"""Files with a checksum behind their content: a single bit that is another is found before it is used.

Whoever reads what stands before it, such as `torch.load` or `numpy.load`, does not mind it.
"""

from __future__ import annotations

import hashlib
import mmap
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import torch

from ..errors import InputError
from ..files import IsOurs, damage_named, open_regular, replacing, require_small

MARK = b"\ntactilerl sha256 "
SEAL_SIZE = len(MARK) + 2 * hashlib.sha256().digest_size


@contextmanager
def writing(path: Path, is_ours: IsOurs | None = None) -> Iterator[BinaryIO]:
    """A file to write to, with its checksum once it is whole; for the rest see `files.replacing`."""
    with replacing(path, is_ours) as file:
        yield file
        file.seek(0)
        digest = hashlib.file_digest(file, "sha256")  # type: ignore[arg-type]  # is readable
        file.write(MARK + digest.hexdigest().encode())


def write(path: Path, content: dict[str, Any], is_ours: IsOurs | None = None) -> None:
    """Write tensors and plain values, and their checksum."""
    with writing(path, is_ours) as file:
        torch.save(content, file)


def read(path: Path, what: str = "checkpoint") -> Any:
    """What `write` was given; InputError where a bit is another, or reading it would run code.

    Tensors are mapped from the file, not copied.
    """
    missing = f"{path}: missing; there is no {what} yet, or it was removed"
    with damage_named(path, f"damaged or not a {what}", missing):
        require_whole(path)
        with open_regular(path) as file:
            require_small(file, 0, 1)  # `torch.save` does not compress
            with zipfile.ZipFile(file) as archive:
                (values,) = (
                    name for name in archive.namelist() if name.endswith("data.pkl")
                )
                if b"bytearray" in archive.read(
                    values
                ):  # which PyTorch would make of any length
                    raise ValueError("it holds a bytearray")
        return torch.load(path, weights_only=True, map_location="cpu", mmap=True)


def read_fields(
    path: Path, what: str, version: int, types: dict[str, type], hint: str = ""
) -> dict[str, Any]:
    """A dict with fields of these types, the first of them the version of its format; InputError when
    that or the fields are others."""
    data, number = read(path, what), next(iter(types))
    found = data.get(number) if isinstance(data, dict) else None
    if type(found) is not int or found != version:
        raise InputError(f"{path}: not a {what} of format {version}{hint}")
    if {name: type(value) for name, value in data.items()} != types:
        raise InputError(f"{path}: damaged (found {', '.join(map(str, data))})")
    return dict(data)


def require_whole(path: Path) -> None:
    """ValueError where a file has no checksum, or one that does not fit."""
    with (
        open_regular(path) as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
    ):
        size = max(0, len(data) - SEAL_SIZE)
        if not data[size:].startswith(MARK):
            raise ValueError(
                "no checksum at its end: cut off, or of a version before 0.2"
            )
        with memoryview(data)[:size] as sealed:
            if data[size:] != MARK + hashlib.sha256(sealed).hexdigest().encode():
                raise ValueError(
                    "its checksum does not match: it was changed after it was written"
                )
