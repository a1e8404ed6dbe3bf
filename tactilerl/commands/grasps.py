"""Find a scripted grasp for a hand whose file has none, and keep it beside the file."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from ..envs import hands
from ..envs.grasp import GraspConfig
from ..envs.simulators import Camera
from ..errors import InputError
from ..files import replacing, require_new
from ..machine import free_cores
from ..pictures import render
from ..scripted import grasp_search
from ..terminal.console import beside, progress

MIN_HELD_SHARE = 0.5  # of the time that an object must be up for a grasp to be of use
HEADER = (
    "# Found by tactilerl for the file beside it, as long as that stays as it is.\n"
)


def require_grasp(name: str, scene: GraspConfig) -> None:
    """Search for a grasp of the hand and keep it, unless its file has one or one is kept beside it.

    Raise ValueError where none holds.
    """
    if hands.get(name).grasps:
        return
    best = find_grasp(name, scene)
    if best is None:
        raise ValueError(
            f"hand {name}: found no grasp that holds; look at [opened] and [closed]"
        )
    path = hands.file(name)
    target = path.with_suffix(hands.GRASP_SUFFIX)
    with replacing(target) as file:
        digest = hands.short_digest(path)
        file.write(f'{HEADER}hand = "{digest}"\n\n{best.toml()}\n'.encode())
    beside.print(f"kept in {target}")


def find_grasp(name: str, scene: GraspConfig) -> grasp_search.FoundGrasp | None:
    """Search for a grasp and return the best; None where it does not hold. Say how it went."""
    beside.print(f"{name} has no [[grasp]]: looking for one")
    with progress("trying grasps", sum(grasp_search.ROUNDS)) as tick:
        best = grasp_search.find(name, scene, free_cores(), tick)
    up = f"{100 * best.share:.0f} % of the time"
    size = f"a {1e3 * best.grasp.object_size:g} mm object"
    if best.share >= MIN_HELD_SHARE:
        beside.print(f"found one: it holds {size} {up}")
        return best
    beside.print(f"found no grasp that holds {size}: the best keeps it up {up}")
    beside.print("look at [opened] and [closed], or at the force of the servos")
    return None


def draw(
    screen: Console, what: str, name: str, scene: GraspConfig, pose: render.Pose, path: Path,
    overwrite: bool,
) -> None:  # fmt: skip
    """Write a picture of a hand, and on the screen `what` it is, or why there is none."""
    try:
        require_new(path, overwrite)
        render.picture(name, scene, pose, Camera(azimuth=300.0), path)
        screen.print(f"{path}: {what}")
    except (ImportError, OSError, InputError) as error:
        screen.print(f"no picture: {error}")
