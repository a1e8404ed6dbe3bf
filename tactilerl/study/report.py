"""report.html and the same as files: tables (Markdown, CSV, LaTeX) and figures (PNG, SVG).

The same records give the same bytes: no file holds a date or a path.
"""

from __future__ import annotations

from base64 import b64encode
from pathlib import Path
from typing import Any

import jinja2

from ..runs.files import replacing
from . import figures, summary, tables
from .analysis import Analysis
from .figures import Picture
from .tables import Table

PARTS = ("comparisons", "differences", "curves", "measures", "converged")
LAST = ["cost", "deviations", "versions", "runs"]


def write(analysis: Analysis, folder: Path) -> Path:
    """Write everything into `folder`, over what an earlier report left there; returns report.html."""
    parts: list[Picture | Table] = [*figures.all_pictures(analysis), *tables.all_tables(analysis)]
    files: dict[Path, bytes] = {}
    for part in parts:
        place = folder / ("tables" if isinstance(part, Table) else "figures") / part.name
        files |= {place.with_name(f"{part.name}.{end}"): text for end, text in part.formats().items()}
    images = {path.stem: b64encode(files[path]).decode() for path in files if path.suffix == ".svg"}
    files[folder / "report.html"] = _page(analysis, parts, images).encode()
    for path, content in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            file.write(content)
    return folder / "report.html"


def _page(analysis: Analysis, parts: list[Picture | Table], images: dict[str, str]) -> str:
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
        sections=_sections(analysis, parts),
        images=images,
    )


def _sections(analysis: Analysis, parts: list[Picture | Table]) -> list[dict[str, Any]]:
    """Headings with the figures and tables below them, in order."""
    names = {
        (f"setup-{one.setup.name}", f"{one.setup.name}: {summary.subject(one)}"): [
            f"{one.setup.name}_{kind}" for kind in PARTS
        ]
        for one in analysis.setups
    }
    names["runs", "Runs, cost and versions"] = LAST
    return [
        {"key": key, "title": title, "parts": found}
        for (key, title), own in names.items()
        if (found := [part for name in own for part in parts if part.name == name])
    ]
