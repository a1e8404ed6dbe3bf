"""Learning curves of a report, on paper of their own, so that they are read in a dark page as well."""

from __future__ import annotations

import io
import itertools
from dataclasses import dataclass
from typing import Any, Literal

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..style import DPI, GROUPS, HEAD, INK, STYLE
from .analysis import SetupResult
from .summary import subject

LEGEND = 2.4  # inches for an entry of the legend
PANEL = 5.2, 3.2  # inches
BAND: dict[str, Any] = {"alpha": 0.13, "lw": 0, "zorder": 1}  # below all curves
LINE: dict[str, Any] = {"alpha": 0.7, "lw": 0.8, "zorder": 2}


@dataclass(frozen=True)
class Curves:
    """The paper's Figures 3 and 5: a panel per setting, IQM with interval and every run."""

    result: SetupResult

    @property
    def name(self) -> str:
        """The name of its file and of its place in report.html."""
        return f"{self.result.setup.name}_curves"

    @property
    def title(self) -> str:
        """Set-up, learner, length and what is drawn."""
        length = self.result.config["run"]["total_timesteps"]
        return f"Learning curves, IQM and every run: {subject(self.result)}, {length:,} steps"

    def image(self, kind: Literal["svg", "png"] = "svg") -> bytes:
        """Draw the curves; the same records give the same bytes."""
        settings = list(dict.fromkeys(setting for setting, _ in self.result.groups))
        columns = min(3, len(settings))
        rows = -(-len(settings) // columns)
        entries: dict[str, Any] = {}
        with matplotlib.rc_context(STYLE):
            size = PANEL[0] * columns, PANEL[1] * rows
            figure = Figure(figsize=size, layout="constrained")
            axes = figure.subplots(rows, columns, squeeze=False).ravel()
            for setting, panel in zip(settings, axes, strict=False):
                self._draw(setting, panel)
                handles, labels = panel.get_legend_handles_labels()
                entries |= dict(zip(labels, handles, strict=True))
            for spare in axes[len(settings) :]:
                spare.set_axis_off()
            n_columns = int(figure.get_figwidth() // LEGEND)
            place: dict[str, Any] = {"loc": "outside lower center", "fontsize": 8}
            figure.legend([*entries.values()], [*entries], ncols=n_columns, **place)
            figure.suptitle(self.title, **HEAD)
            file, volatile = io.BytesIO(), "Date" if kind == "svg" else "Software"
            figure.savefig(file, format=kind, dpi=DPI, metadata={volatile: None})
        return file.getvalue()

    def _draw(self, setting: str, axes: Axes) -> None:
        steps, setup = self.result.steps, self.result.setup
        marker = "o" if len(steps) == 1 else None
        for colour, name in zip(itertools.cycle(GROUPS), setup.groups, strict=False):
            group = self.result.groups.get((setting, name))
            if group is not None:
                label = f"{setup.label(name)}, IQM".removeprefix("all, ")
                axes.fill_between(steps, *group.iqm_bounds.T, color=colour, **BAND)
                axes.plot(steps, group.curves.T, color=colour, **LINE)
                axes.plot(
                    steps,
                    group.iqm_curve,
                    color=colour,
                    lw=2.2,
                    marker=marker,
                    label=label,
                )
        axes.plot([], [], color=INK, label="a run", **LINE)
        axes.fill_between([], [], color=INK, label="95 % interval of the IQM", **BAND)
        rate = setup.measure.replace("_", " ")
        axes.set(xlabel="environment steps", ylabel=rate, ylim=(-0.02, 1.02))
        axes.set_title("" if setting == "all" else setting)
        axes.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(4))
        axes.xaxis.set_major_formatter(matplotlib.ticker.EngFormatter(sep=""))
