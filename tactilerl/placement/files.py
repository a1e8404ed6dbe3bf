"""Write what a design leaves: layouts with a drawing each, and in a folder a page and JSON."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

from ..envs import layouts
from ..errors import InputError
from ..files import as_json, locked, replacing, require_new
from .choice import Design
from .drawing import drawing
from .page import page

DRAWING = ".svg"


def require(out: Path, is_one: bool, overwrite: bool) -> None:
    """Raise InputError where nothing can be written to `out`, before minutes of playing.

    One layout may go into a file; it, and several, into a folder.
    """
    if out.suffix == ".toml":
        if not is_one:
            raise InputError(
                f"--out: found {str(out)!r}, allowed a folder for several numbers of taxels"
            )
        if not out.parent.is_dir():
            raise InputError(f"--out: found no folder {str(out.parent)!r}")
        require_new(out.with_suffix(DRAWING), overwrite)
    elif out.suffix or (out.exists() and not out.is_dir()):
        raise InputError(f"--out: found {str(out)!r}, allowed FILE.toml or a folder")
    require_new(out, overwrite)


def write(design: Design, out: Path) -> dict[Path, float | None]:
    """Write the layouts, drawings, and in a folder a page and JSON; return which files those are.

    Of layouts, return which set each is. ValueError where a layout would not be read again, and then
    nothing is written.
    """
    pool, sets = design.pool, list(design.chosen)
    is_file = out.suffix == ".toml"
    contents: dict[Path, bytes] = {}
    written: dict[Path, float | None] = {}
    for key in sets[-1:] if is_file else sets:
        layout = design.layout(key)
        text = layout.toml()
        taxels = layouts.load(text).place(pool.hand)
        path = out if is_file else out / f"design_{key:g}.toml"
        contents[path], written[path] = text.encode(), key
        drawn = drawing(pool.hand, taxels, layout.description)
        contents[path.with_suffix(DRAWING)] = drawn.encode()
    if not is_file:
        contents[out / "design.html"] = page(design)
        contents[out / "design.json"] = as_json(design.as_dict())
    with nullcontext() if is_file else locked(out):
        for path, content in contents.items():
            with replacing(path) as file:
                file.write(content)
    return {path: written.get(path) for path in contents}
