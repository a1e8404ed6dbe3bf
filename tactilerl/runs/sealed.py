"""A file of tensors with its checksum, read without running its code.

The checksum stands behind what `torch.save` wrote, so `torch.load(path, weights_only=True)` reads
the file as well, only without looking at it.
"""

from __future__ import annotations

import hashlib
import os
import pickletools
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import torch

from ..errors import InputError
from .files import open_regular, replacing

MARK = b"\ntactilerl sha256 "
SEAL_SIZE = len(MARK) + 2 * hashlib.sha256().digest_size
MAX_PICKLE = 4_000_000  # bytes besides the tensors: some 700 ranks
# All that tensors, dicts, lists and numbers need. `weights_only` would allow more, such as a
# bytearray of any length.
KNOWN = {"collections OrderedDict", "torch._utils _rebuild_tensor_v2"}
KNOWN |= {f"torch {kind}Storage" for kind in ("Float", "Double", "Long", "Int", "Byte", "Bool")}


def write(path: Path, content: dict[str, Any]) -> None:
    """Write tensors and plain values, and their checksum."""
    with replacing(path) as file:
        torch.save(content, file)
        size = file.tell()
        file.seek(0)
        digest = _digest(file, size)
        file.write(MARK + digest.encode())


def read(path: Path, what: str = "checkpoint") -> Any:
    """What `write` was given; InputError when a single bit is another, or it holds anything else.

    Tensors are mapped from the file, not copied.
    """
    try:
        _require_seal(path)
        _require_plain(path)
        return torch.load(path, weights_only=True, map_location="cpu", mmap=True)
    except FileNotFoundError:
        raise InputError(f"{path}: missing; there is no {what} yet, or it was removed") from None
    except Exception as error:  # zipfile, pickletools and torch answer garbage with errors of any kind
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: damaged or not a {what} ({reason})") from error


def _require_seal(path: Path) -> None:
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size - SEAL_SIZE
        file.seek(max(0, size))
        seal = file.read()
        if not seal.startswith(MARK):
            raise ValueError("no checksum at its end: cut off, or of a version before 0.2")
        file.seek(0)
        digest = _digest(file, size)
    if seal != MARK + digest.encode():
        raise ValueError("its checksum does not match: it was changed after it was written")


def _digest(file: BinaryIO, size: int) -> str:
    """SHA-256 of the next `size` bytes."""
    digest = hashlib.sha256()
    while size > 0 and (piece := file.read(min(size, 2**20))):
        digest.update(piece)
        size -= len(piece)
    return digest.hexdigest()


def _require_plain(path: Path) -> None:
    """ValueError when the archive unpacks to more than it is, or its pickle holds what is not known."""
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise ValueError("it is compressed")
        if sum(entry.file_size for entry in entries) > path.stat().st_size:
            raise ValueError("it unpacks to more than its size")
        (pickled,) = (entry for entry in entries if entry.filename.endswith("data.pkl"))
        if pickled.file_size > MAX_PICKLE:
            raise ValueError(f"{pickled.file_size:,} bytes of plain values, allowed {MAX_PICKLE:,}")
        for opcode, name, _ in pickletools.genops(archive.read(pickled)):
            if "GLOBAL" in opcode.name and name not in KNOWN:
                raise ValueError(f"it holds {name}, which is neither a tensor nor a plain value")
