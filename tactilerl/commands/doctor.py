"""`tactilerl doctor`: do the taxels feel?"""

from __future__ import annotations

import dataclasses
import json
from typing import Annotated

from rich.table import Table

from ..envs.grasp import GraspConfig, setup
from ..envs.objects import Items, ObjectConfig
from ..errors import InputError, input_errors
from ..probe import doctor
from ..terminal import flags
from ..terminal.console import console
from ..terminal.help import About
from .grasps import require_grasp
from .scene import layout_notes, read_scene

FEW = 10  # taxels that are named


ABOUT = About(
    "Check which taxels fire. Plays scripted grasps and shows, for each layout, how many taxels fire "
    "while the object is held. The exit code is 1 if the taxels of a layout hardly ever fire.",
    first=("layout", "touch_rule", "simulator", "object", "object_size"),
    defaults={"layout": "each of 1 to 6"},
    examples=(
        "tactilerl doctor --env shadow",
        "tactilerl doctor --env mpl --layout my_layout.toml",
    ),
)


@dataclasses.dataclass(frozen=True)
class DoctorFlags:
    """Flags of `tactilerl doctor`, besides the scene's."""

    env: str = "shadow"
    """A hand: shadow, mpl, allegro, or the path of a hand's .toml file."""
    grasps: Annotated[int, "[1, inf)"] = 20
    """Number of grasps per layout, each slightly different."""
    seconds: Annotated[float, "[0.05, 60]"] = 3.0
    """Length of each hold, s."""
    json: bool = False
    """Print JSON instead of a table, with the names of all taxels that never fired."""


USED = {"simulator", "layout", "touch_rule", "timestep", "finger_gain"}
USED |= {field.name for field in dataclasses.fields(ObjectConfig)} - {"jitter"}


def _require_used(scene: GraspConfig, env: str) -> None:
    """InputError for flags of the scene on which scripted grasps of one object do not depend."""
    if scene.task == "handover":
        raise InputError(
            "--task: found handover, allowed tasks whose object lies on the ground; for a handover use "
            "tactilerl gate"
        )
    for name, usual in vars(setup(env)).items():
        if name not in USED and (found := getattr(scene, name)) != usual:
            flag = flags.of_field(name)
            raise InputError(
                f"{flag}: found {found}, which has no effect here; leave it out"
            )
    with input_errors():
        if Items(scene).vary:
            raise ValueError(
                "object: found several, or a range, allowed a single object"
            )


def main(args: list[str]) -> int:
    """`tactilerl doctor`: exit 1 when a layout is blind."""
    read, scene = read_scene(DoctorFlags, args, "tactilerl doctor", ABOUT)
    name = read.env
    _require_used(scene, name)
    chosen = flags.peek(args, "--layout", "")
    names = [chosen] if chosen else [*"123456"]
    with input_errors():
        require_grasp(name, scene)
        scenes = [dataclasses.replace(scene, layout=layout) for layout in names]
        figures = [
            doctor.examine(name, each, read.grasps, read.seconds) for each in scenes
        ]
    code = int(any(f.is_blind for f in figures))
    if read.json:
        print(json.dumps([dataclasses.asdict(f) for f in figures]))
        return code
    table = Table(
        title=f"{name} in {scene.simulator}, rule {scene.touch_rule}: taxels during the hold"
    )
    for column in (
        "layout",
        "taxels",
        "held",
        "taxels on",
        "steps with any",
        "never fired",
        "",
    ):
        table.add_column(column, justify="right")
    for f in figures:
        table.add_row(
            *(f.layout, str(f.taxels), f"{f.held}/{f.grasps}", f"{f.mean_bits:.2f}"),
            *(
                f"{100 * f.share_any:.0f} %",
                str(len(f.never_fired)),
                "blind" if f.is_blind else "ok",
            ),
        )
    console.print(table)
    for f in figures:
        if 0 < len(f.never_fired) <= FEW:
            console.print(f"layout {f.layout} never fired: {', '.join(f.never_fired)}")
        for note in layout_notes(name, f.layout):
            console.print(note)
    return code
