"""The figures of a report, on paper of their own, so that they are read in a dark page as well."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..statistics import METRICS, Estimate
from ..style import ARMS, DPI, FAINT, HEAD, INK, STYLE, arm
from .analysis import Analysis, SetupResult
from .grid import SCORES
from .summary import subject

LABELS = {"median": "median of runs", "iqm": "IQM", "mean": "mean"}
LEGEND = 2.4  # inches for an entry of the legend
Draw = Callable[[Axes], None]


@dataclass(frozen=True)
class Picture:
    """Panels that stand together."""

    name: str
    """Of its files and of its place in report.html."""
    title: str
    """What is drawn."""
    of: str
    """What it is drawn of."""
    panels: Sequence[tuple[str, Draw]]
    size: tuple[float, float]
    """Of a panel, inches."""

    def formats(self) -> dict[str, bytes]:
        """The picture in each format, by the ending of its file."""
        columns = min(3, len(self.panels))
        rows = -(-len(self.panels) // columns)
        made: dict[str, bytes] = {}
        shown: dict[str, Any] = {}
        with matplotlib.rc_context(STYLE):
            figure = Figure(figsize=(self.size[0] * columns, self.size[1] * rows), layout="constrained")
            axes = figure.subplots(rows, columns, squeeze=False).ravel()
            for (title, draw), one in zip(self.panels, axes, strict=False):
                draw(one)
                one.set_title(title)
                handles, labels = one.get_legend_handles_labels()
                shown |= dict(zip(labels, handles, strict=True))
            for spare in axes[len(self.panels) :]:
                spare.set_axis_off()
            figure.legend(
                [*shown.values()], [*shown], loc="outside lower center",
                ncols=int(figure.get_figwidth() // LEGEND),
                fontsize=8, columnspacing=1.0, handletextpad=0.4,
            )  # fmt: skip
            figure.suptitle(self.of, **HEAD)
            for ending, unsaid in (("svg", "Date"), ("png", "Software")):
                file = io.BytesIO()
                figure.savefig(file, format=ending, dpi=DPI, metadata={unsaid: None})
                made[ending] = file.getvalue()
        return made


def all_pictures(analysis: Analysis) -> list[Picture]:
    """Every figure of a report, in its order."""
    pictures = []
    for one in analysis.setups:
        if one.comparisons:
            pictures.append(differences(one, analysis.study.primary.score))
        if one.groups:
            pictures += [curves(one), converged(one)]
    return pictures


def _of(one: SetupResult) -> str:
    """Hand, simulator, learner and length."""
    return f"{subject(one)}, {one.config['run']['total_timesteps']:,} steps"


def _label(text: str) -> str:
    """Of a cell or an arm; the only one there is needs none."""
    return "" if text == "all" else arm(text)


def _arm_colours(one: SetupResult) -> dict[str, str]:
    return {name: ARMS[index % len(ARMS)] for index, name in enumerate(one.setup.arms)}


def differences(one: SetupResult, score: str) -> Picture:
    """Every pair's difference by the primary score, and their means with intervals."""
    treatment, control = map(one.setup.label, one.setup.arms[:2])
    label = f"{SCORES[score]}: {treatment} − {control}"
    title = f"{treatment} − {control}, {SCORES[score]}: each pair, mean and 95 % interval"
    panels = [("", partial(_differences_of, one, label))]
    size = 6.4, 1.5 + 0.45 * len(one.comparisons)
    return Picture(f"{one.setup.name}_differences", title, _of(one), panels, size)


def _differences_of(one: SetupResult, label: str, axes: Axes) -> None:
    axes.axvline(0, color=INK, linewidth=0.8)
    for row, found in enumerate(one.comparisons.values()):
        pairs, is_first = found.verdict.pairs, row == 0
        gaps = pairs.treatment - pairs.control
        axes.plot(
            gaps, np.full(len(gaps), row + 0.22), ".", color=FAINT, ms=6, label="a pair" * is_first
        )
        if len(gaps):
            _bar(axes, row, pairs.difference, ARMS[0], "s", "their mean" * is_first)
    axes.set_yticks(range(len(one.comparisons)), map(_label, one.comparisons))
    axes.set(ylim=(len(one.comparisons) - 0.5, -0.5), xlabel=label)
    low, high = axes.get_xlim()
    axes.set_xlim(min(low, -0.1), max(high, 0.1))
    axes.grid(axis="y", visible=False)


def curves(one: SetupResult) -> Picture:
    """The paper's Figures 3 and 5: a panel per cell, IQM with interval and every run."""
    panels = [(_label(cell), partial(_curves_of, one, cell)) for cell in one.cells]
    title = "Learning curves: IQM with 95 % interval, and every run"
    return Picture(f"{one.setup.name}_curves", title, _of(one), panels, (5.2, 3.2))


def _curves_of(one: SetupResult, cell: str, axes: Axes) -> None:
    for name, colour in _arm_colours(one).items():
        group = one.groups.get((cell, name))
        if group is None:
            continue
        # Bands below everything and so light that two of them do not mix to a third colour.
        axes.fill_between(one.steps, *group.iqm_bounds.T, color=colour, alpha=0.13, lw=0, zorder=1)
        axes.plot(one.steps, group.curves.T, color=colour, lw=0.8, alpha=0.7, zorder=2)
        marker, named = "o" if len(one.steps) == 1 else None, _label(one.setup.label(name))
        label = ", ".join(filter(None, [named, "IQM"]))
        axes.plot(
            one.steps, group.iqm_curve, color=colour, lw=2.2, label=label, marker=marker, zorder=3
        )
    axes.plot([], [], color=INK, lw=0.8, alpha=0.7, label="a run")
    axes.fill_between([], [], color=INK, alpha=0.13, lw=0, label="95 % interval of the IQM")
    axes.set(xlabel="environment steps", ylabel=one.setup.measure.replace("_", " "), ylim=(-0.02, 1.02))
    axes.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(4))
    axes.xaxis.set_major_formatter(matplotlib.ticker.EngFormatter(sep=""))


def converged(one: SetupResult) -> Picture:
    """The paper's Figures 4 and 6: median, IQM and mean of converged rates, a panel per arm."""
    arms = [name for name in one.setup.arms if any(name == each for _, each in one.groups)]
    panels = [(_label(one.setup.label(name)), partial(_converged_of, one, name)) for name in arms]
    title = "Converged success rates, the paper's measure, with 95 % intervals"
    size = 5.2, 1.3 + 0.62 * len(one.cells)
    return Picture(f"{one.setup.name}_converged", title, _of(one), panels, size)


def _converged_of(one: SetupResult, name: str, axes: Axes) -> None:
    colour, cells = _arm_colours(one)[name], one.cells
    for row, cell in enumerate(cells):
        group = one.groups.get((cell, name))
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
    axes.set(ylim=(len(cells) - 0.4, -0.6), xlim=(-0.02, 1.02), xlabel="converged success rate")
    axes.set_yticks(range(len(cells)), map(_label, cells))
    axes.grid(axis="y", visible=False)


def _bar(axes: Axes, y: float, estimate: Estimate, colour: str, marker: str, label: str) -> None:
    axes.plot(estimate[1:], [y, y], color=colour, linewidth=2.2, alpha=0.55, solid_capstyle="butt")
    axes.plot(estimate.value, y, marker, color=colour, ms=4.5, label=label)
