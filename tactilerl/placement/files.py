"""Write what a design leaves: layout files, a picture, and in a folder a page and JSON."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..envs import layouts
from ..errors import InputError
from ..files import locked, replacing, require_new
from ..pictures.hand_map import TaxelMap, save_picture
from .choice import Design
from .page import page

PIXELS = 900  # height of the hand in its picture
SPOT = 1e-3  # m, radius of a candidate there


def paths(out: Path, numbers: Sequence[int]) -> list[Path]:
    """Return which files are written, layouts first; InputError where `out` can be no such place."""
    if out.suffix == ".toml":
        if len(numbers) > 1:
            raise InputError(
                f"--out: found {str(out)!r}, allowed a folder for several numbers of taxels"
            )
        if not out.parent.is_dir():
            raise InputError(f"--out: found no folder {str(out.parent)!r}")
        return [out, out.with_suffix(".png")]
    if out.suffix or (out.exists() and not out.is_dir()):
        raise InputError(f"--out: found {str(out)!r}, allowed FILE.toml or a folder")
    names = [f"design_{n}.toml" for n in numbers]
    return [out / name for name in [*names, "hand.png", "design.html", "design.json"]]


def require(out: Path, numbers: Sequence[int], overwrite: bool) -> None:
    """Raise InputError where nothing can be written to `out`, before minutes of playing."""
    for path in [out, *paths(out, numbers)]:
        require_new(path, overwrite)


def write(design: Design, out: Path) -> list[Path]:
    """Write the layouts, a picture, and in a folder a page and JSON; return which files those are.

    ValueError where a layout would not be read again, and then nothing is written.
    """
    texts = [design.layout(n).toml() for n in design.chosen]
    for text in texts:
        layouts.load(text).place(design.pool.hand)
    contents = [*(text.encode() for text in texts), _picture(design)]
    files = paths(out, list(design.chosen))
    if len(files) > len(contents):
        contents.append(page(design))
        contents.append((json.dumps(design.as_dict(), indent=1) + "\n").encode())
    with nullcontext() if out.suffix else locked(out):
        for path, content in zip(files, contents, strict=True):
            with replacing(path) as file:
                file.write(content)
    return files


def _picture(design: Design) -> bytes:
    """Return a PNG of the unrolled hand with the largest chosen set lit, and spots for candidates."""
    pool, file = design.pool, io.BytesIO()
    chosen = design.chosen[max(design.chosen)]
    skin = pool.skin.take(pool.columns)
    points = [
        point
        if column in pool.existing or column in chosen
        else point._replace(radius=SPOT)
        for column, point in zip(pool.columns, skin.points, strict=True)
    ]
    drawn = TaxelMap(pool.hand, replace(skin, points=tuple(points)), PIXELS)
    save_picture(drawn.picture(np.isin(pool.columns, chosen)), file, ".png")
    return file.getvalue()
