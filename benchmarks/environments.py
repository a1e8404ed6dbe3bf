"""The pages of docs/environments, from the code: facts, spaces, arguments, and what the gate found.

`make docs` makes one page for each named scene and each hand. `python -m benchmarks tables` writes the
table of all arguments into the overview, and that of all sensors into its guide.
"""

from __future__ import annotations

import dataclasses
import io
import itertools
import re
from collections.abc import Callable, Iterable
from contextlib import redirect_stdout
from functools import cache
from typing import Any

from docstring_parser import parse_from_object
from tactilerl.envs import hands, scenes, sensors
from tactilerl.envs.grasp import GraspConfig, GraspEnv, setup
from tactilerl.envs.hands import LinearAction

from benchmarks.command import DOCS, data, markdown

UNITS = {  # of entries whose names begin like that
    "position of slide|hand |object [xyz]": "m",
    "position of": "rad",
    "velocity of slide": "m/s",
    "velocity of": "rad/s",
    "taxels of": "0 or 1",
    "taxels,|all but": "",
}


def _named(name: str) -> scenes.NamedScene:
    return scenes.NamedScene(env=name) if name in hands.HANDS else scenes.load(name)


@cache
def _made(name: str) -> tuple[GraspConfig, GraspEnv]:
    """Return a configuration, and its environment in MuJoCo, which is always installed."""
    named = _named(name)
    config = setup(named.env, **named.scene)
    return config, GraspEnv(named.env, dataclasses.replace(config, simulator="mujoco"))


def facts(name: str) -> None:
    """Print the facts at the head of a page."""
    config, env = _made(name)
    is_hand = name in hands.HANDS
    ours = hands.described(name).environment["id"] if is_hand else scenes.gymnasium_id(name)
    spaces = env.observation_space.spaces.items()
    rows = {
        "Make": f'`gymnasium.make("{ours}")`, after `import tactilerl`',
        "Hand and simulator": f"`{_named(name).env}` in `{config.simulator}`",
        "Task": f"`{config.task}`",
        "Action space": f"`Box(-1, 1, {env.action_space.shape}, float32)`",
        "Observation space": "Dict of " + ", ".join(f"`{key}` {box.shape}" for key, box in spaces),
        "Episode": f"up to {env.max_episode_steps} actions of {config.control_dt:g} s",
        "Taxels": f"{len(env.taxels)}, of layout {config.layout}",
    }
    _table(("", ""), rows.items())


def observation(name: str) -> None:
    """Print every entry of an observation; taxels of a digit share a row."""
    entries = enumerate(map(_entry, _made(name)[1].observation_names()))
    rows = []
    for entry, group in itertools.groupby(entries, lambda each: each[1]):
        numbers = [number for number, _ in group]
        span = "–".join(map(str, dict.fromkeys((numbers[0], numbers[-1]))))
        rows.append((span, entry, next((UNITS[k] for k in UNITS if re.match(k, entry)), "1")))
    _table(("number", "observation", "unit"), rows)


def _entry(entry: str) -> str:
    if late := re.search(r" \(t-(\d+)\)$", entry):
        what = "taxels" if entry.startswith("taxel ") else "all but the taxels"
        return f"{what}, {late[1]} step{'s' * (late[1] > '1')} before"
    palm = re.sub(r"taxel .*\.palm\[.*", "taxels of the palm", entry)
    return re.sub(r"taxel (\w+)\..*", r"taxels of the \1 finger", palm).replace("thumb finger", "thumb")


def action(name: str) -> None:
    """Print what the two ends of each action mean."""
    hand = _made(name)[1].hand
    does, names = hand.action_map, enumerate(hand.action_names)
    if isinstance(does, LinearAction):
        ends = [
            (f"{c - r:.3g}", f"{c + r:.3g}") for c, r in zip(does.centre, does.half_range, strict=True)
        ]
        rows = [(i, f"`{each}`", *ends[i], "m" if "slide" in each else "rad") for i, each in names]
        return _table(("number", "target of", "at −1", "at 1", "unit"), rows)
    slides = zip(does.slide_step, does.slide_limits, strict=True)
    moves = [(f"{step:g}", f"{low:g} to {high:g}", "m") for step, (low, high) in slides]
    moves += [(f"{does.closing_step:g}", "0 (open) to 1 (closed)", "1")] * len(does.groups)
    head = ("number", "moves the target of", "by up to", "within", "unit")
    return _table(head, [(i, each.replace("_", " "), *moves[i]) for i, each in names])


def arguments(name: str) -> None:
    """Print where a scene differs from `GraspConfig`'s defaults."""
    config, usual = vars(_made(name)[0]), vars(GraspConfig())
    rows = [
        (f"`{key}`", _value(config[key]), _value(usual[key]))
        for key in config
        if config[key] != usual[key]
    ]
    if not rows:
        print("None: this environment has the defaults.")
        return
    _table(("argument", "here", "default"), rows)


def all_arguments() -> None:
    """Print every field of `GraspConfig`, those of a task and an object first."""
    defaults, rows = vars(GraspConfig()), []
    for field in itertools.chain(
        *(parse_from_object(kind).params for kind in GraspConfig.__mro__[-2::-1])
    ):
        about = " ".join((field.description or "").split()).replace("|", "\\|")
        rows.append((f"`{field.arg_name}`", _value(defaults[field.arg_name]), about))
    _table(("argument", "default", "meaning"), rows)


def shipped_sensors() -> None:
    """Print what is known of each sensor of the library."""
    numbers = {
        "radius, mm": ("radius", 1e3),
        "threshold, N": ("threshold", 1),
        "release, N": ("release", 1),
        "spread of threshold": ("threshold_spread", 1),
        "delay, ms": ("delay", 1e3),
        "dead": ("dead", 1),
        "saturates, N": ("saturates", 1),
        "noise, N": ("noise", 1),
        "spread of gain": ("gain_spread", 1),
    }
    rows = []
    for sensor in map(sensors.load, sensors.names()):
        known = [(sensor.numbers.get(f"taxel_{field}"), x) for field, x in numbers.values()]
        cells = ["" if value is None else f"{scale * value:.3g}" for value, scale in known]
        rows.append((f"`{sensor.name}`", sensor.about, *cells))
    _table(("name", "sensor", *numbers), rows)


def gate(name: str) -> None:
    """Print success rates of scripted hands: in a scene, or with a hand in the handover."""
    gates = data("gates")
    row = gates["handover"][f"{name}, mujoco"] if name in hands.HANDS else gates["scenes"].get(name)
    if row is None:
        print("Not measured yet.")
        return
    rates = {key: each["rate"] for key, each in row["reflexes"].items()}
    _table(("scripted hand", *rates), [("success rate", *(f"{rate:.2f}" for rate in rates.values()))])


def _value(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(_value, value))
    return f"`{value:.4g}`" if isinstance(value, float) else f"`{value}`"


def _table(head: tuple[str, ...], rows: Iterable[tuple[Any, ...]]) -> None:
    markdown(f"| {' | '.join(head)} |", rows)


TABLES = {"all arguments": all_arguments, "sensors": shipped_sensors}
TASKS = {"lift-and-hold": "lift-and-hold", "reach-goal": "reach-a-goal", "handover": "handover"}
"""Where concepts/tasks.md explains each."""


def names() -> tuple[str, ...]:
    """Return the names of all scenes, then of all hands: each has a page."""
    return (*scenes.names(), *hands.HANDS)


def title(name: str) -> str:
    """Return a page's title: the Gymnasium id without what all ids share."""
    is_hand = name in hands.HANDS
    ours = hands.described(name).environment["id"] if is_hand else scenes.gymnasium_id(name)
    return ours.removeprefix("tactilerl/").removesuffix("-v0")


def page(name: str) -> str:
    """Return the page of a named scene or a hand, in Markdown."""
    config, _ = _made(name)
    named, task = _named(name), TASKS[config.task]
    pictures = (name, f"{named.env}_{config.simulator}")
    picture = next(each for each in pictures if (DOCS / f"images/{each}.png").is_file())
    about = named.about or "A hand for every task, object, simulator and layout."
    where = ", in the task handover in MuJoCo" if name in hands.HANDS else ""
    return f"""# {title(name)}

![{title(name)}](../images/{picture}.png)

{about}

{_printed(facts, name)}
Rewards and the end of an episode are those of [the task](../concepts/tasks.md#{task}).

## Observation space

[What the policy senses](../concepts/senses.md) explains the entries.

{_printed(observation, name)}
## Action space

{_printed(action, name)}
## Arguments

What differs from the defaults. The overview has [all arguments](README.md#all-arguments).

{_printed(arguments, name)}
## Scripted baselines

Success rates over 200 starts of scripted policies that close at a signal of one
sense{where} ([gates](../gates.md)).

{_printed(gate, name)}"""


def _printed(show: Callable[[str], None], name: str) -> str:
    with redirect_stdout(io.StringIO()) as printed:
        show(name)
    return printed.getvalue()
