"""report.html and the same as files: tables (Markdown, CSV, LaTeX) and figures (PNG, SVG).

The same records give the same bytes: no file holds a date or a path.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jinja2

from ..files import replacing
from . import figures, tables
from .analysis import Analysis
from .figures import Picture
from .statistics import FEW_RUNS
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
        summary=_summary(analysis),
        warnings=tables.warnings(analysis, FEW_RUNS),
        sections=_sections(analysis, all_tables, pictures),
        colours=figures.ARMS,
    )


def _summary(analysis: Analysis) -> list[str]:
    """What came out, a sentence per comparison that an interval tells apart from nothing."""
    done = sum(record.state == "done" for record in analysis.records)
    said = [f"{done} of {len(analysis.records)} runs in {len(analysis.setups)} set-ups are finished."]
    for one in analysis.setups:
        if not one.comparisons:
            continue
        arms = one.setup.arms[:2]
        clear = [c for c in one.comparisons.values() if c.p_holm <= 0.05]
        names = ", ".join(f"{c.cell} ({c.difference.value:+.2f})" for c in clear)
        result = f"in {names}" if clear else f"in none of {len(one.comparisons)} comparisons"
        said.append(
            f"{one.setup.name}: {arms[0]} and {arms[1]} differ {result} "
            "(converged rates, permutation test, Holm, 0.05)."
        )
    return said


def _sections(
    analysis: Analysis, all_tables: list[Table], pictures: list[Picture]
) -> list[dict[str, Any]]:
    """Headings with the figures and tables below them, in order."""
    names = [one.setup.name for one in analysis.setups]
    titles = {
        **{name: name for name in names},
        "over": "Over the set-ups",
        "runs": "Runs, cost and versions",
    }

    def place(name: str) -> str:
        own = [setup for setup in names if name in {f"{setup}_{part}" for part in PARTS}]
        return own[0] if own else "over" if name in OVER else "runs"

    sections = []
    for key, title in titles.items():
        section = {
            "key": f"setup-{key}" if key in names else key,
            "title": title,
            "pictures": [p for p in pictures if place(p.name) == key],
            "tables": [t for t in all_tables if place(t.name) == key],
        }
        if section["pictures"] or section["tables"]:
            sections.append(section)
    return sections


PARTS = ("curves", "converged", "measures", "comparisons")
OVER = ("differences", "agreement", "mixed_model")


def _write(path: Path, text: str) -> None:
    with replacing(path) as file:
        file.write(text.encode())
