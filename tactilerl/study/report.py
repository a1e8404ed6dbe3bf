"""report.html and the same as files: tables (Markdown, CSV, LaTeX), figures (PNG, SVG) and scores.

The same records give the same bytes: no file holds a date or a path.
"""

from __future__ import annotations

from base64 import b64encode
from pathlib import Path
from typing import NamedTuple

import jinja2

from ..files import content as read
from ..files import own_folder, replacing, require_ours
from . import export, figures, summary, tables
from .analysis import Analysis
from .figures import Picture
from .tables import Table

TEMPLATE = "report.html.j2"
FOOTER = b"Made by <code>tactilerl study report</code>"  # of every version


class Section(NamedTuple):
    """A heading with the figures and tables below it."""

    key: str
    title: str
    parts: list[Picture | Table]


def write(analysis: Analysis, folder: Path) -> Path:
    """Write everything into `folder`, over what an earlier report left there; returns report.html.

    InputError where other files would be lost. report.html comes first: it says whose the folder is.
    """
    page, beside, images = folder / "report.html", dict[Path, bytes](), {}
    require_ours(page, lambda path: FOOTER in read(path))
    made = sections(analysis)
    for part in (part for section in made for part in section.parts):
        place = (
            folder / ("tables" if isinstance(part, Table) else "figures") / part.name
        )
        formats = part.formats()
        beside |= {
            place.with_name(f"{part.name}.{ending}"): it
            for ending, it in formats.items()
        }
        images[part.name] = b64encode(formats.get("svg", b"")).decode()
    beside |= {folder / "scores.csv": export.scores(analysis)}
    beside |= {folder / "scores.npz": export.arrays(analysis)}
    is_new = not page.exists()
    folder.mkdir(parents=True, exist_ok=True)
    for path in beside:
        if path.parent != folder:
            own_folder(path.parent)
        require_ours(path, (lambda _: False) if is_new else None)
    for path, content in {
        page: _page(analysis, made, images).encode(),
        **beside,
    }.items():
        with replacing(path) as file:
            file.write(content)
    return page


def _page(analysis: Analysis, made: list[Section], images: dict[str, str]) -> str:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("tactilerl.study", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template(TEMPLATE).render(
        study=analysis.study,
        about=[
            summary.about(one, analysis.study.primary.score) for one in analysis.setups
        ],
        provenance=summary.provenance(analysis.records),
        answers=summary.answers(analysis),
        warnings=summary.warnings(analysis),
        sections=made,
        images=images,
    )


def sections(analysis: Analysis) -> list[Section]:
    """All of a report, in its order."""
    score, found = analysis.study.primary.score, []
    for one in analysis.setups:
        parts: list[Picture | Table] = []
        if one.comparisons:
            parts += [tables.comparisons(one, score), figures.differences(one, score)]
        if one.groups:
            parts += [figures.curves(one), tables.measures(one, score)]
        title = f"{one.setup.name}: {summary.subject(one)}"
        found.append(Section(f"setup-{one.setup.name}", title, parts))
    about = (tables.cost, tables.deviations, tables.versions, tables.runs)
    last: list[Picture | Table] = [
        made for table in about if (made := table(analysis)).rows
    ]
    return [
        one
        for one in (*found, Section("runs", "Runs, cost and versions", last))
        if one.parts
    ]
