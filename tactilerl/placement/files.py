"""What a design leaves: layout files, and in a folder its figures and JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from ..errors import InputError, extra
from ..files import locked, replacing, require_new
from .choice import Design


def require(out: Path, numbers: Sequence[int], overwrite: bool) -> None:
    """Raise InputError where nothing can be written to `out`, before minutes of playing."""
    if out.suffix == ".toml":
        if len(numbers) > 1:
            allowed = "a folder for several numbers of taxels"
            raise InputError(f"--out: found {str(out)!r}, allowed {allowed}")
        if not out.parent.is_dir():
            raise InputError(f"--out: found no folder {str(out.parent)!r}")
    elif out.suffix or (out.exists() and not out.is_dir()):
        raise InputError(f"--out: found {str(out)!r}, allowed FILE.toml or a folder")
    else:
        with extra("plots"):
            from . import figures  # noqa: F401
        names = [f"design_{n}.toml" for n in numbers]
        names += ["design.json", "hand.png", "curve.png"]
        for name in names:
            require_new(out / name, overwrite)
    require_new(out, overwrite)


def write(design: Design, out: Path) -> list[Path]:
    """Write the layout, or all there is, layouts first; return which files those are."""
    if out.suffix == ".toml":
        return [_layout(design, max(design.chosen), out)]
    from . import figures

    with locked(out):
        files = [_layout(design, n, out / f"design_{n}.toml") for n in design.chosen]
        files.append(out / "design.json")
        with replacing(files[-1]) as file:
            file.write((json.dumps(design.as_dict(), indent=1) + "\n").encode())
        for name, figure in figures.of_design(design).items():
            files.append(out / f"{name}.png")
            figures.save(figure, files[-1])
        return files


def _layout(design: Design, n: int, path: Path) -> Path:
    with replacing(path) as file:
        file.write(design.layout(n).toml().encode())
    return path
