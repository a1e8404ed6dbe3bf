"""Learning curves of a report, on paper of their own, so that they are read in a dark page as well."""

from __future__ import annotations

import io
import itertools
from typing import Any, Literal

import matplotlib
from matplotlib.figure import Figure

from ..style import DPI, GROUPS, MORE_COLOURS, ROLES, STYLE
from .analysis import SetupResult
from .grid import Setup

PANEL = 5.2, 3.2  # inches
BAND: dict[str, Any] = {"alpha": 0.13, "lw": 0, "zorder": 1}  # below all curves
LINE: dict[str, Any] = {"alpha": 0.7, "lw": 0.8, "zorder": 2}


def title(result: SetupResult) -> str:
    """Return what the curves of a set-up show."""
    length = result.config["run"]["total_timesteps"]
    return (
        f"Learning curves: every run, and the mean with its 95 % interval: {result.subject}, "
        f"{length:,} steps a run"
    )


def colours(setup: Setup) -> dict[str, str]:
    """Return the colour of each group: that of its touch wherever it stands, others by order."""
    by_touch = dict(zip(ROLES, GROUPS, strict=False))
    others = zip(setup.groups, itertools.cycle(MORE_COLOURS), strict=False)
    return {name: by_touch.get(name, colour) for name, colour in others}


@matplotlib.rc_context(STYLE)
def curves(result: SetupResult, kind: Literal["svg", "png"] = "svg") -> bytes:
    """Draw a panel per setting, as the paper's Figures 3 and 5: mean with interval, and every run.

    The same records give the same bytes.
    """
    setup, steps = result.setup, result.steps
    settings = list(dict.fromkeys(setting for setting, _ in result.groups))
    columns = min(3, len(settings))
    rows = -(-len(settings) // columns)
    figure = Figure((PANEL[0] * columns, PANEL[1] * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    by_group = colours(setup)
    for panel in panels[len(settings) :]:
        panel.remove()
    for setting, panel in zip(settings, panels, strict=False):
        for name, colour in by_group.items():
            if group := result.groups.get((setting, name)):
                panel.fill_between(steps, *group.bounds.T, color=colour, **BAND)
                panel.plot(steps, group.curves.T, color=colour, **LINE)
                panel.plot(steps, group.mean_curve, color=colour, lw=2.2)
        rate = setup.measure.replace("_", " ")
        panel.set(xlabel="environment steps", ylabel=rate, ylim=(-0.02, 1.02))
        panel.set_title("" if setting == "all" else setting)
        panel.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(4))
        panel.xaxis.set_major_formatter(matplotlib.ticker.EngFormatter(sep=""))
    for name, colour in by_group.items():
        panels[0].plot([], [], color=colour, lw=2.2, label=f"{setup.label(name)}, mean")
    figure.legend(loc="outside lower center", fontsize=8, ncols=2 * columns)
    file, volatile = io.BytesIO(), "Date" if kind == "svg" else "Software"
    figure.savefig(file, format=kind, dpi=DPI, metadata={volatile: None})
    return file.getvalue()
