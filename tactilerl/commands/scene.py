"""What commands share: a scene's flags, notes about its taxels, and a grasp where its hand has none."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from ..envs import hands, layouts, scenes, tasks, validation
from ..envs.grasp import GraspConfig, setup
from ..envs.observations import Broken
from ..envs.scenes import NamedScene
from ..envs.validation import nearest
from ..errors import InputError, input_errors
from ..files import replacing
from ..machine import free_cores
from ..scripted import grasp_search
from ..terminal import flags
from ..terminal.console import Progress, beside

T = TypeVar("T")
MIN_HELD_SHARE = 0.5  # of the time that an object must be up for a grasp to be of use
HEADER = (
    "# Found by tactilerl for the file beside it, as long as that stays as it is.\n"
)


@dataclass(frozen=True)
class SceneFlag:
    """A scene, whose values the other flags override."""

    scene: str = ""
    """A named scene (`tactilerl env` lists them) or a scene's .toml file; other flags
    override it."""


def require_hand(env: str, *others: str) -> None:
    """Raise InputError for an environment that is neither a hand nor one of `others`."""
    if not hands.is_hand(env) and env not in others:
        hint = nearest(env, [*hands.HANDS, *others])
        raise InputError(f"env: found {env!r}, {hint}allowed: {hands.allowed()}")


def read_scene(
    kind: type[T], args: Sequence[str], prog: str, about: str, **usual: Any
) -> tuple[T, GraspConfig]:
    """Return the command's own flags and the scene; InputError where its environment is no hand.

    `usual` are defaults of the command, whatever the scene has.
    """
    command: Any = kind()
    given = flags.peek(args, "scene", "env")
    with input_errors():
        name, usual_env = given["scene"], NamedScene(env=command.env)
        named = scenes.load(name) if name else usual_env
    env = given["env"] or named.env
    require_hand(env)
    with input_errors(f"scene {name}" if name else ""):
        scene = setup(env, **{**named.on(env), **usual})
        validation.validate(scene)  # before tyro reads it as the defaults
    command = dataclasses.replace(command, env=env)
    parts = {"command": command, "named": SceneFlag(), "scene": scene}
    read = flags.parse_parts(parts, args, prog, about)
    return read.command, read.scene


def sensor_notes(name: str, scene: GraspConfig) -> list[str]:
    """Return notes about a hand's taxels that are not what one may think.

    They fire at any contact, fire when touch is of no use any more, or are too few for
    a share of them to be broken.
    """
    if scene.touch != "on":
        return []
    taxels = layouts.load(scene.layout).place(hands.get(name))
    shares = {"dead": scene.taxel_dead, "stuck": scene.taxel_stuck}
    broken = Broken(len(taxels), **shares, seed=0)
    notes = [
        f"taxel_{what} {share:g}: none of {len(taxels)} taxels is {what}"
        for what, share in shares.items()
        if share and not getattr(broken, what).any()
    ]
    force, giver = scene.taxel_threshold, tasks.TASKS[scene.task].giver
    if force is None:
        if scene.sensor and scene.touch_rule == "skin" and not taxels.thresholds.any():
            notes.append(
                f"{scene.sensor} names no threshold: its taxels fire at any contact"
            )
    elif giver is not None and force > scene.giver_force:
        notes.append(
            f"threshold {force:g} N is above --giver-force {scene.giver_force:g} N: touch comes "
            "too late"
        )
    return notes


def warn(notes: Sequence[str]) -> None:
    """Print notes on standard error, each once."""
    for note in dict.fromkeys(notes):
        beside.print(f"note: {note}")


def layout_notes(name: str, layout: str) -> list[str]:
    """Return notes about a layout on a hand.

    They name places where it wants taxels and the hand has no surface, and its taxels
    off the skin of theirs.

    Raise ValueError where it names places that the hand lacks and does not say that it
    may.
    """
    wanted, hand = layouts.load(layout), hands.get(name)
    about, notes = f"layout {layouts.short(layout)}:", [*hand.notes]
    if wanted.is_model and (lost := str(hand.sensors)):
        notes.append(f"{about} {lost}")
    if missing := ", ".join(layouts.left_out(wanted, hand)):
        notes.append(f"{about} no taxels at {missing}, which {name} does not have")
    if off_skin := ", ".join(layouts.off_skin(wanted.place(hand), hand)):
        notes.append(f"{about} off the skin of their segment: {off_skin}")
    return notes


def require_grasp(name: str, scene: GraspConfig) -> None:
    """Search for a grasp of the hand and keep it, unless it has one, or what it takes is handed over.

    Raise ValueError where none holds.
    """
    if hands.get(name).grasps or tasks.TASKS[scene.task].giver is not None:
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
    tick = Progress("trying grasps", sum(grasp_search.ROUNDS))
    best = grasp_search.find(name, scene, free_cores(), tick)
    up = f"{100 * best.share:.0f} % of the time"
    size = f"a {1e3 * best.grasp.object_size:g} mm object"
    if best.share >= MIN_HELD_SHARE:
        beside.print(f"found one: it holds {size} {up}")
        return best
    beside.print(f"found no grasp that holds {size}: the best keeps it up {up}")
    beside.print("look at [opened] and [closed], or at the force of the servos")
    return None
