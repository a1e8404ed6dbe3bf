"""report.html, and the same as files: tables as CSV, figures as SVG.

The same records give the same bytes: no file holds a date or a path.
"""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass
from pathlib import Path

import jinja2

from ..files import content, own_folder, replacing, require_ours
from . import summary, tables
from .analysis import Analysis
from .figures import Curves
from .tables import Table

TEMPLATE = "report.html.j2"
FOOTER = b"Made by <code>tactilerl study report</code>"  # of every version


@dataclass(frozen=True)
class Section:
    """A heading with the figures and tables below it."""

    key: str
    title: str
    parts: list[Curves | Table]


def write(analysis: Analysis, folder: Path) -> Path:
    """Write everything into `folder`, over an earlier report there; return report.html's path.

    Raises InputError where a file of another kind would be lost.
    """
    page, files, images = folder / "report.html", dict[Path, bytes](), {}
    require_ours(page, lambda path: FOOTER in content(path))
    report = sections(analysis)
    for part in (part for section in report for part in section.parts):
        if isinstance(part, Table):
            files[folder / "tables" / f"{part.name}.csv"] = part.csv()
        else:
            image = files[folder / "figures" / f"{part.name}.svg"] = part.image()
            images[part.name] = b64encode(image).decode()
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("tactilerl.study", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    score = analysis.study.primary.score
    html = environment.get_template(TEMPLATE).render(
        study=analysis.study,
        about=[summary.about(result, score) for result in analysis.setups],
        provenance=summary.provenance(analysis.records),
        answers=summary.answers(analysis),
        warnings=summary.warnings(analysis),
        sections=report,
        images=images,
    )
    is_new = not page.exists()
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("tables", "figures"):
        own_folder(folder / name)
    for path in files:
        require_ours(path, (lambda _: False) if is_new else None)
    for path, data in {
        page: html.encode(),
        **files,
    }.items():  # the page says whose it is
        with replacing(path) as file:
            file.write(data)
    return page


def sections(analysis: Analysis) -> list[Section]:
    """Return the sections of a report, in its order."""
    score, report = analysis.study.primary.score, []
    for one in analysis.setups:
        parts: list[Curves | Table] = []
        if one.verdicts:
            parts.append(tables.comparisons(one, score))
        if one.groups:
            parts += [Curves(one), tables.measures(one, score)]
            title = f"{one.setup.name}: {summary.subject(one)}"
            report.append(Section(f"setup-{one.setup.name}", title, parts))
    kinds = tables.cost, tables.deviations, tables.versions, tables.runs
    about = [table for kind in kinds if (table := kind(analysis)).rows]
    report.append(Section("runs", "Runs, cost and versions", [*about]))
    return report
