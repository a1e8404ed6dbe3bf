"""`tactilerl env`: what an environment consists of."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import Any

import gymnasium as gym

from .. import envs
from ..envs import scenes, tasks
from ..envs.grasp import GraspConfig, GraspEnv
from ..errors import InputError, input_errors
from ..scripted import taxels
from ..scripted.taxels import TaxelCheck
from .grasps import require_grasp
from .scene import layout_notes, read_any

ABOUT = """\
Describe an environment: what it is, its actions, observations and taxels. Without flags it also
lists the named scenes.

examples:
  tactilerl env --scene handover
  tactilerl env --env shadow --layout 4 --describe
  tactilerl env --env mpl --layout my_layout.toml --check"""


@dataclass(frozen=True)
class EnvFlags:
    """Flags of `tactilerl env`, besides the scene's."""

    env: str = "shadow"
    """A hand, a toy (lqr, point-reach) or a Gymnasium id."""
    describe: bool = False
    """List every entry of the observation and the action."""
    check: bool = False
    """Play scripted grasps and say which taxels fire while the object is held and which never do. The
    exit code is 1 where one never does."""
    json: bool = False
    """Print JSON instead of text."""


def main(args: list[str]) -> int:
    """`tactilerl env --describe`: exit 1 where --check finds a taxel that never fires."""
    read, scene = read_any(EnvFlags, args, "tactilerl env", ABOUT)
    with input_errors():
        made = GraspEnv(read.env, scene) if scene else envs.make(read.env)
        with closing(made):
            described = _described(read.env, made, scene)
        check = None
        if read.check:
            check = _checked(read.env, scene)
            described["check"] = asdict(check)
    if read.json:
        print(json.dumps(described))
    else:
        for name in ("action_space", "observation_space"):
            described[name] = _short(getattr(made, name))
        lines = _lines(described, read.describe, check)
        if not args:
            lines.append("named scenes (--scene NAME):")
            lines += [
                f"  {name:18} {scenes.load(name).about}" for name in scenes.names()
            ]
        print("\n".join(lines))
    return int(check is not None and bool(check.never_fired))


def _described(name: str, env: Any, scene: GraspConfig | None) -> dict[str, Any]:
    """Return what there is to say about an environment, as JSON has it."""
    described: dict[str, Any] = {
        "env": name,
        "action_space": str(env.action_space),
        "observation_space": str(env.observation_space),
    }
    if scene is not None:
        length = f"up to {env.max_episode_steps} actions of {scene.control_dt:g} s"
        described |= {
            "task": f"{scene.task} in {scene.simulator}, {length}",
            "observation": env.observation_names(),
            "action": env.hand.action_names,
            "taxels": len(env.taxels),
            "notes": layout_notes(name, scene.layout),
        }
    return described


def _checked(name: str, scene: GraspConfig | None) -> TaxelCheck:
    """Play scripted grasps; where the hand has none, one is searched for."""
    if scene is None:
        raise InputError(f"--check: found {name}, allowed the environments of hands")
    if tasks.TASKS[scene.task].giver is None:
        require_grasp(name, scene)
    return taxels.check(name, scene)


def _lines(
    described: dict[str, Any], everything: bool, check: TaxelCheck | None
) -> list[str]:
    """Return what is printed of it."""
    single = ("env", "task", "action_space", "observation_space", "taxels")
    lines = [f"{key}: {described[key]}" for key in single if key in described]
    lines += [f"note: {note}" for note in described.get("notes", ())]
    for key in ("action", "observation") if everything else ():
        entries = enumerate(described.get(key, ()))
        lines += [f"{key}[{i}] {entry}" for i, entry in entries]
    if check is not None:
        n_taxels = described["taxels"]
        lines += [
            f"check: {check.held} of {check.grasps} scripted grasps hold; {len(check.fired)} of "
            f"{n_taxels} taxels fire in them, {check.mean_fired:.1f} at a time, and some taxel in "
            f"{100 * check.share_any:.0f} % of the time",
            f"fired: {', '.join(check.fired) or 'none'}",
            f"never fired: {', '.join(check.never_fired) or 'none'}",
        ]
    return lines


def _short(space: gym.Space[Any]) -> str:
    """Return one line; bounds that are infinite, or differ between entries, are left out."""
    if isinstance(space, gym.spaces.Dict):
        parts = (f"{key}: {_short(part)}" for key, part in space.spaces.items())
        return f"Dict({', '.join(parts)})"
    whole = str(space)
    if "[" in whole or "inf" in whole:
        return f"{type(space).__name__}{space.shape}"
    return whole
