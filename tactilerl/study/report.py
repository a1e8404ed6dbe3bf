"""report.html and the same as files: tables (Markdown, CSV, LaTeX) and figures (PNG, SVG).

The same records give the same bytes: no file holds a date or a path.
"""

from __future__ import annotations

from base64 import b64encode
from pathlib import Path
from typing import NamedTuple

import jinja2

from ..runs.files import replacing
from . import figures, summary, tables
from .analysis import Analysis
from .figures import Picture
from .tables import Table


class Section(NamedTuple):
    """A heading with the figures and tables below it."""

    key: str
    title: str
    parts: list[Picture | Table]


def write(analysis: Analysis, folder: Path) -> Path:
    """Write everything into `folder`, over what an earlier report left there; returns report.html."""
    made, images = sections(analysis), {}
    files: dict[Path, bytes] = {}
    for part in (part for section in made for part in section.parts):
        place = folder / ("tables" if isinstance(part, Table) else "figures") / part.name
        formats = part.formats()
        files |= {place.with_name(f"{part.name}.{ending}"): it for ending, it in formats.items()}
        images[part.name] = b64encode(formats.get("svg", b"")).decode()
    files[folder / "report.html"] = _page(analysis, made, images).encode()
    for path, content in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            file.write(content)
    return folder / "report.html"


def _page(analysis: Analysis, made: list[Section], images: dict[str, str]) -> str:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("tactilerl.study", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template("report.html.j2").render(
        study=analysis.study,
        about=[summary.about(one, analysis.study.primary.score) for one in analysis.setups],
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
    last: list[Picture | Table] = [made for table in about if (made := table(analysis)).rows]
    return [one for one in (*found, Section("runs", "Runs, cost and versions", last)) if one.parts]
