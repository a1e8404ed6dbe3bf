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

from ..statistics import Estimate
from ..style import ARMS, DPI, FAINT, HEAD, INK, STYLE
from .analysis import SetupResult
from .summary import MEANS, subject

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
            figure = Figure(
                figsize=(self.size[0] * columns, self.size[1] * rows),
                layout="constrained",
            )
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


def setting(one: SetupResult) -> str:
    """Hand, simulator, learner and length."""
    return f"{subject(one)}, {one.config['run']['total_timesteps']:,} steps"


def label_of(text: str) -> str:
    """Of a cell or an arm; the only one there is needs none."""
    return "" if text == "all" else text


def arm_colours(one: SetupResult) -> dict[str, str]:
    """A colour for each arm."""
    return {name: ARMS[index % len(ARMS)] for index, name in enumerate(one.setup.arms)}


def differences(one: SetupResult, score: str) -> Picture:
    """Every pair's difference by the primary score, and their means with intervals."""
    treatment, control = map(one.setup.label, one.setup.arms[:2])
    label = f"{MEANS[score]}: {treatment} − {control}"
    title = (
        f"{treatment} − {control}, {MEANS[score]}: each pair, mean and 95 % interval"
    )
    panels = [("", partial(_differences_of, one, label))]
    size = 6.4, 1.5 + 0.45 * len(one.comparisons)
    return Picture(f"{one.setup.name}_differences", title, setting(one), panels, size)


def _differences_of(one: SetupResult, label: str, axes: Axes) -> None:
    axes.axvline(0, color=INK, linewidth=0.8)
    for row, found in enumerate(one.comparisons.values()):
        pairs, is_first = found.verdict.pairs, row == 0
        gaps = pairs.treatment - pairs.control
        axes.plot(
            gaps,
            np.full(len(gaps), row + 0.22),
            ".",
            color=FAINT,
            ms=6,
            label="a pair" * is_first,
        )
        if len(gaps):
            bar(axes, row, pairs.difference, ARMS[0], "s", "their mean" * is_first)
    axes.set_yticks(range(len(one.comparisons)), map(label_of, one.comparisons))
    axes.set(ylim=(len(one.comparisons) - 0.5, -0.5), xlabel=label)
    low, high = axes.get_xlim()
    axes.set_xlim(min(low, -0.1), max(high, 0.1))
    axes.grid(axis="y", visible=False)


def curves(one: SetupResult) -> Picture:
    """The paper's Figures 3 and 5: a panel per cell, IQM with interval and every run."""
    panels = [(label_of(cell), partial(_curves_of, one, cell)) for cell in one.cells]
    title = "Learning curves: IQM with 95 % interval, and every run"
    return Picture(f"{one.setup.name}_curves", title, setting(one), panels, (5.2, 3.2))


def _curves_of(one: SetupResult, cell: str, axes: Axes) -> None:
    for name, colour in arm_colours(one).items():
        group = one.groups.get((cell, name))
        if group is None:
            continue
        # Bands below everything and so light that two of them do not mix to a third colour.
        axes.fill_between(
            one.steps, *group.iqm_bounds.T, color=colour, alpha=0.13, lw=0, zorder=1
        )
        axes.plot(one.steps, group.curves.T, color=colour, lw=0.8, alpha=0.7, zorder=2)
        marker, named = (
            "o" if len(one.steps) == 1 else None,
            label_of(one.setup.label(name)),
        )
        label = ", ".join(filter(None, [named, "IQM"]))
        axes.plot(
            one.steps,
            group.iqm_curve,
            color=colour,
            lw=2.2,
            label=label,
            marker=marker,
            zorder=3,
        )
    axes.plot([], [], color=INK, lw=0.8, alpha=0.7, label="a run")
    axes.fill_between(
        [], [], color=INK, alpha=0.13, lw=0, label="95 % interval of the IQM"
    )
    axes.set(
        xlabel="environment steps",
        ylabel=one.setup.measure.replace("_", " "),
        ylim=(-0.02, 1.02),
    )
    axes.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(4))
    axes.xaxis.set_major_formatter(matplotlib.ticker.EngFormatter(sep=""))


def bar(
    axes: Axes, y: float, estimate: Estimate, colour: str, marker: str, label: str
) -> None:
    """An estimate and its interval."""
    axes.plot(
        estimate[1:],
        [y, y],
        color=colour,
        linewidth=2.2,
        alpha=0.55,
        solid_capstyle="butt",
    )
    axes.plot(estimate.value, y, marker, color=colour, ms=4.5, label=label)
