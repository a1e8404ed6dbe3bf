"""One look and one set of names for every figure, of reports and of the docs."""

from __future__ import annotations

from typing import Any

INK, FAINT = "#1b1f24", "#b0b0b1"
GROUPS = "#e0a800", "#2b6cb0", "#8a5a9e", "#4d8f5b"  # as in the paper, treatment first
MORE_COLOURS = "#1f8a8a", "#b03020", "#6b7280", "#c2588b", "#7a6a1f", "#3f4f9e"
ROLES = {"on": "touch", "off": "no touch", "absent": "no touch, and no inputs for it"}
"""Names of groups of a study by their value of `touch`."""
NAMES = {
    "shadow": "Shadow Hand",
    "mpl": "MPL hand",
    "allegro": "Allegro Hand",
    "mujoco": "MuJoCo",
    "pybullet": "PyBullet",
    "ppo": "PPO",
    "ddpg_her": "DDPG+HER",
}
STYLE: dict[Any, Any] = {  # with it the same input gives the same bytes
    "svg.hashsalt": "tactilerl",
    "text.parse_math": False,  # names may hold "$"
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.prop_cycle": f"cycler('color', {list(MORE_COLOURS)})",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.4,
    "legend.frameon": False,
    **{
        f"{part}color": INK
        for part in ("text.", "axes.label", "axes.edge", "xtick.", "ytick.")
    },
}
DPI = 180
HEAD: dict[str, Any] = {"x": 0.01, "ha": "left", "fontweight": "bold", "wrap": True}
"""Place and weight of a figure's title."""
