"""A file of tensors with its checksum, read without running its code.

The checksum stands behind what `torch.save` wrote, so `torch.load(path, weights_only=True)` reads
the file as well, only without looking at it.
"""

from __future__ import annotations

import hashlib
import mmap
import pickletools
import zipfile
from pathlib import Path
from typing import Any

import torch

from ..errors import InputError
from .files import IsOurs, damage_named, open_regular, replacing

MARK = b"\ntactilerl sha256 "
SEAL_SIZE = len(MARK) + 2 * hashlib.sha256().digest_size
MAX_PICKLE = 4_000_000  # bytes besides the tensors: some 700 ranks
# All that tensors, dicts, lists and numbers need. `weights_only` would allow more, such as a
# bytearray of any length.
KNOWN = {"collections OrderedDict", "torch._utils _rebuild_tensor_v2"}
KNOWN |= {f"torch {kind}Storage" for kind in ("Float", "Double", "Long", "Int", "Byte", "Bool")}


def write(path: Path, content: dict[str, Any], is_ours: IsOurs | None = None) -> None:
    """Write tensors and plain values, and their checksum; for `is_ours` see `files.replacing`."""
    with replacing(path, is_ours) as file:
        torch.save(content, file)
        file.seek(0)
        digest = hashlib.file_digest(file, "sha256")  # type: ignore[arg-type]  # is readable
        file.write(MARK + digest.hexdigest().encode())


def seal(path: Path) -> str:
    """The checksum that `write` wrote, of a file that was read."""
    return path.read_bytes()[-SEAL_SIZE:].removeprefix(MARK).decode()


def read(path: Path, what: str = "checkpoint") -> Any:
    """What `write` was given; InputError when a single bit is another, or it holds anything else.

    Tensors are mapped from the file, not copied.
    """
    missing = f"{path}: missing; there is no {what} yet, or it was removed"
    with damage_named(path, f"damaged or not a {what}", missing):
        _require_seal(path)
        _require_plain(path)
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


def _require_seal(path: Path) -> None:
    with open_regular(path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        size = max(0, len(data) - SEAL_SIZE)
        if not data[size:].startswith(MARK):
            raise ValueError("no checksum at its end: cut off, or of a version before 0.2")
        with memoryview(data)[:size] as sealed:
            if data[size:] != MARK + hashlib.sha256(sealed).hexdigest().encode():
                raise ValueError("its checksum does not match: it was changed after it was written")


def _require_plain(path: Path) -> None:
    """ValueError when the archive unpacks to more than it is, or its pickle holds what is not known."""
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        if sum(entry.file_size for entry in entries) > path.stat().st_size:
            raise ValueError("it is compressed, or unpacks to more than its size")
        (pickled,) = (entry for entry in entries if entry.filename.endswith("data.pkl"))
        if pickled.file_size > MAX_PICKLE:
            raise ValueError(f"{pickled.file_size:,} bytes of plain values, allowed {MAX_PICKLE:,}")
        for opcode, name, _ in pickletools.genops(archive.read(pickled)):
            if "GLOBAL" in opcode.name and name not in KNOWN:
                raise ValueError(f"it holds {name}, which is neither a tensor nor a plain value")
