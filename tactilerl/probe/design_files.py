"""What a design leaves: layout files, and in a folder its figures and JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from ..envs import validation
from ..errors import InputError, extra
from ..files import is_picture, locked, read_json, replacing, require_ours
from .candidates import MADE, Design


def is_layout(path: Path) -> bool:
    """Is the layout file one that was designed?"""
    return MADE in str(validation.read(path, "layout file").get("description"))


def is_result(path: Path) -> bool:
    """Is the JSON file one of a design?"""
    return MADE in read_json(path).get("about", "")


def require(out: Path | None, numbers: Sequence[int]) -> None:
    """InputError where nothing can be written to `out`, before minutes of playing."""
    if out is None:
        return
    if out.suffix == ".toml":
        if len(numbers) > 1:
            raise InputError(
                f"--out: found {str(out)!r}, allowed a folder for several numbers of taxels"
            )
        require_ours(out, is_layout)
        if not out.parent.is_dir():
            raise InputError(
                f"cannot write {str(out)!r}: there is no folder {str(out.parent)!r}"
            )
    elif out.suffix:
        raise InputError(f"--out: found {str(out)!r}, allowed FILE.toml or a folder")
    elif (out.exists() or out.is_symlink()) and not out.is_dir():
        raise InputError(f"--out: found {str(out)!r}, which is no folder")
    else:
        with extra("plots"):
            from . import figures  # noqa: F401
        require_ours(out / "design.json", is_result)


def write(found: Design, out: Path | None) -> list[Path]:
    """The layout, or all of it; which files were written."""
    if out is None:
        return []
    if out.suffix == ".toml":
        return [_layout(found, max(found.chosen), out)]
    from . import figures

    with locked(out):
        files = [_layout(found, n, out / f"design_{n}.toml") for n in found.chosen]
        files.append(out / "design.json")
        with replacing(files[-1], is_result) as file:
            about = {"about": f"taxels {MADE}", **found.result}
            file.write((json.dumps(about, indent=1) + "\n").encode())
        return [*files, *figures.save(figures.of_design(found), out, is_picture)]


def _layout(found: Design, n: int, path: Path) -> Path:
    with replacing(path, is_layout) as file:
        file.write(found.layout(n).toml().encode())
    return path
