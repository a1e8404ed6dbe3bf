"""The figures of a report: as files, and as parts of report.html that follow its light and dark."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..runs.files import replacing
from ..statistics import METRICS, Estimate
from .analysis import Analysis, SetupResult
from .primary import SCORES
from .summary import length, subject

INK, FAINT = "#010203", "#b0b0b1"  # become colours of the page in report.html
ARMS = ("#e0a800", "#2b6cb0", "#8a5a9e", "#4d8f5b")  # treatment and control as in the paper
STYLE: dict[Any, Any] = {  # with it the same input gives the same bytes
    "svg.hashsalt": "tactilerl",
    "text.parse_math": False,  # names may hold "$"
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.4,
    **dict.fromkeys(
        ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), INK
    ),
    "axes.titlecolor": INK,
}
PAGE_COLOURS = {INK: "currentColor", FAINT: "var(--faint)"} | {
    colour: f"var(--arm{index})" for index, colour in enumerate(ARMS)
}
DPI = 130
LABELS = {"median": "median of runs", "iqm": "IQM", "mean": "mean"}
Draw = Callable[[Axes], None]


class Picture:
    """Panels that stand together: one file, and side by side on a page as wide as it is."""

    def __init__(
        self, name: str, title: str, panels: Sequence[tuple[str, Draw]], size: tuple[float, float]
    ) -> None:
        self.name, self.title, self.panels, self.size = name, title, panels, size

    def save(self, folder: Path) -> None:
        """Write NAME.png and NAME.svg."""
        columns = min(3, len(self.panels))
        rows = -(-len(self.panels) // columns)
        with matplotlib.rc_context(STYLE):
            figure = Figure(figsize=(self.size[0] * columns, self.size[1] * rows), layout="constrained")
            axes = figure.subplots(rows, columns, squeeze=False).ravel()
            for (title, draw), one in zip(self.panels, axes, strict=False):
                draw(one)
                one.set_title(title, loc="left")
            for spare in axes[len(self.panels) :]:
                spare.set_axis_off()
            _legend(figure)
            figure.suptitle(self.title, x=0.01, ha="left", wrap=True)
            for ending, unsaid in (("svg", "Date"), ("png", "Software")):
                with replacing(folder / f"{self.name}.{ending}") as file:
                    figure.savefig(file, format=ending, dpi=DPI, metadata={unsaid: None})

    def inline(self) -> list[str]:
        """Every panel as SVG for the page."""
        return [self._panel(index, *panel) for index, panel in enumerate(self.panels)]

    def _panel(self, index: int, title: str, draw: Draw) -> str:
        with matplotlib.rc_context(STYLE):
            figure = Figure(figsize=self.size, layout="constrained")
            figure.patch.set_alpha(0)
            axes = figure.subplots()
            axes.patch.set_alpha(0)
            draw(axes)
            axes.set_title(title, loc="left")
            _legend(figure)
            text = io.StringIO()
            figure.savefig(text, format="svg", metadata={"Date": None})
        return _for_page(text.getvalue(), f"{self.name}-{index}", f"{self.title}: {title}")


def _legend(figure: Figure) -> None:
    """What all panels show, below them."""
    shown: dict[str, Any] = {}
    for axes in figure.axes:
        handles, labels = axes.get_legend_handles_labels()
        shown |= dict(zip(labels, handles, strict=True))
    figure.legend(
        shown.values(), shown.keys(), loc="outside lower center", ncols=5, frameon=False, fontsize=8,
        columnspacing=1.0, handletextpad=0.4,
    )  # fmt: skip


def _for_page(svg: str, prefix: str, label: str) -> str:
    """SVG that takes the page's colours, fits its width, and shares no id with another."""
    svg, prefix = svg[svg.index("<svg") :], html.escape(prefix)
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\bid="', f'id="{prefix}-', svg)
    svg = re.sub(r'href="#', f'href="#{prefix}-', svg)
    svg = re.sub(r"url\(#", f"url(#{prefix}-", svg)
    svg = re.sub(
        r'(<svg[^>]*?) width="[^"]*"', r"\1", re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg)
    )
    svg = svg.replace("<svg", f'<svg role="img" aria-label="{html.escape(label)}"', 1)
    for colour, variable in PAGE_COLOURS.items():
        svg = svg.replace(colour, variable)
    return svg


def all_pictures(analysis: Analysis) -> list[Picture]:
    """Every figure of a report, in its order."""
    pictures = []
    for one in analysis.setups:
        if one.comparisons:
            pictures.append(differences(one, analysis.study.primary.score))
        if one.groups:
            pictures += [curves(one), converged(one)]
    return pictures


def _arm_colours(one: SetupResult) -> dict[str, str]:
    return {arm: ARMS[index % len(ARMS)] for index, arm in enumerate(one.setup.arms)}


def differences(one: SetupResult, score: str) -> Picture:
    """Every pair's difference by the primary score, and their means with intervals."""
    treatment, control = (one.setup.label(arm) for arm in one.setup.arms[:2])
    title = f"{treatment} − {control}, {SCORES[score]}: {subject(one)}"
    panels = [("each pair, mean and 95 % interval", partial(_differences_of, one, score))]
    return Picture(
        f"{one.setup.name}_differences", title, panels, (6.4, 1.3 + 0.45 * len(one.comparisons))
    )


def _differences_of(one: SetupResult, score: str, axes: Axes) -> None:
    axes.axvline(0, color=INK, linewidth=0.8)
    for row, found in enumerate(one.comparisons.values()):
        pairs, is_first = found.verdict.pairs, row == 0
        gaps = pairs.treatment - pairs.control
        axes.plot(
            gaps, np.full(len(gaps), row + 0.22), ".", color=FAINT, ms=6, label="a pair" * is_first
        )
        if len(gaps):
            _bar(axes, row, pairs.difference, ARMS[0], "s", "their mean" * is_first)
    axes.set_yticks(range(len(one.comparisons)), list(one.comparisons))
    names = [one.setup.label(arm) for arm in one.setup.arms[:2]]
    label = f"{SCORES[score]}: {names[0]} − {names[1]}"
    axes.set(ylim=(len(one.comparisons) - 0.5, -0.5), xlabel=label)
    low, high = axes.get_xlim()
    axes.set_xlim(min(low, -0.1), max(high, 0.1))
    axes.grid(axis="y", visible=False)


def curves(one: SetupResult) -> Picture:
    """The paper's Figures 3 and 5: a panel per cell, IQM with interval, runs over it."""
    title = f"{subject(one)}{length(one)}: IQM with 95 % interval, and every run"
    panels = [("" if cell == "all" else cell, partial(_curves_of, one, cell)) for cell in one.cells]
    return Picture(f"{one.setup.name}_curves", title, panels, (5.2 if len(panels) > 1 else 7.2, 3.4))


def _curves_of(one: SetupResult, cell: str, axes: Axes) -> None:
    for arm, colour in _arm_colours(one).items():
        group = one.groups.get((cell, arm))
        if group is None:
            continue
        faintness = min(0.9, 4 / len(group))  # many runs must not bury their aggregate
        axes.fill_between(one.steps, *group.iqm_bounds.T, color=colour, alpha=0.15, lw=0, zorder=1)
        axes.plot(one.steps, group.curves.T, color=colour, lw=0.7, alpha=faintness, zorder=2)
        marker, label = "o" if len(one.steps) == 1 else None, one.setup.label(arm)
        axes.plot(one.steps, group.iqm_curve, color=colour, lw=1.8, label=label, marker=marker)
    axes.set(xlabel="environment steps", ylabel=one.setup.measure.replace("_", " "), ylim=(-0.02, 1.02))
    axes.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(4))
    axes.xaxis.set_major_formatter(matplotlib.ticker.EngFormatter(sep=""))


def converged(one: SetupResult) -> Picture:
    """The paper's Figures 4 and 6: median, IQM and mean of converged rates, a panel per arm."""
    arms = [arm for arm in one.setup.arms if any(arm == a for _, a in one.groups)]
    height = 1.1 + 0.62 * len(one.cells)
    title = f"Converged success rates, the paper's measure, 95 % intervals: {subject(one)}"
    panels = [(one.setup.label(arm), partial(_converged_of, one, arm)) for arm in arms]
    return Picture(f"{one.setup.name}_converged", title, panels, (5.2, height))


def _converged_of(one: SetupResult, arm: str, axes: Axes) -> None:
    colour, cells = _arm_colours(one)[arm], one.cells
    for row, cell in enumerate(cells):
        group = one.groups.get((cell, arm))
        if group is None:
            continue
        is_first = not axes.get_legend_handles_labels()[1]
        place = np.full(len(group), row - 0.36)
        label = "a run" * is_first
        axes.plot(group.scores["converged"], place, ".", color=FAINT, ms=4, label=label)
        for at, metric in enumerate(reversed(METRICS)):
            estimate = group.estimate(metric, "converged")
            label = LABELS[metric] * is_first
            _bar(axes, row - 0.15 + 0.15 * at, estimate, colour, "Dos"[at], label)
        theirs = one.published and one.published.estimates.get((cell, arm))
        if theirs:
            _bar(axes, row + 0.33, theirs["iqm"], INK, "x", "IQM in the paper" * is_first)
    axes.set(ylim=(len(cells) - 0.4, -0.6), xlim=(-0.02, 1.02), xlabel="converged success rate")
    axes.set_yticks(range(len(cells)), cells)
    axes.grid(axis="y", visible=False)


def _bar(axes: Axes, y: float, estimate: Estimate, colour: str, marker: str, label: str) -> None:
    axes.plot(estimate[1:], [y, y], color=colour, linewidth=2.2, alpha=0.55, solid_capstyle="butt")
    axes.plot(estimate.value, y, marker, color=colour, ms=4.5, label=label)
