"""report.html and the same as files: tables (Markdown, CSV, LaTeX) and figures (PNG, SVG).

The same records give the same bytes: no file holds a date or a path.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jinja2

from ..runs.files import replacing
from . import figures, summary, tables
from .analysis import Analysis
from .figures import Picture
from .tables import Table


def write(analysis: Analysis, folder: Path) -> Path:
    """Write everything into `folder`, over what an earlier report left there; returns report.html."""
    for name in ("tables", "figures"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    all_tables, pictures = tables.all_tables(analysis), figures.all_pictures(analysis)
    for table in all_tables:
        for ending, text in table.formats().items():
            _write(folder / "tables" / f"{table.name}.{ending}", text)
    for picture in pictures:
        picture.save(folder / "figures")
    path = folder / "report.html"
    _write(path, page(analysis, all_tables, pictures))
    return path


def page(analysis: Analysis, all_tables: list[Table], pictures: list[Picture]) -> str:
    """report.html"""
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
        sections=_sections(analysis, all_tables, pictures),
        colours=figures.ARMS,
    )


def _sections(
    analysis: Analysis, all_tables: list[Table], pictures: list[Picture]
) -> list[dict[str, Any]]:
    """Headings with the figures and tables below them, in order."""
    parts: list[Picture | Table] = [*pictures, *all_tables]
    sections = []
    for one in analysis.setups:
        names = [f"{one.setup.name}_{part}" for part in PARTS]
        sections.append((f"setup-{one.setup.name}", f"{one.setup.name}: {summary.subject(one)}", names))
    sections.append(("over", "Over the set-ups", list(OVER)))
    sections.append(("runs", "Runs, cost and versions", ["cost", "deviations", "versions", "runs"]))
    found = []
    for key, title, names in sections:
        own = [part for name in names for part in parts if part.name == name]
        if own:
            shown = [(isinstance(part, Picture), part) for part in own]
            found.append({"key": key, "title": title, "parts": shown})
    return found


PARTS = ("comparisons", "differences", "curves", "measures", "converged", "paper")
OVER = ("agreement", "mixed_model")


def _write(path: Path, text: str) -> None:
    with replacing(path) as file:
        file.write(text.encode())
