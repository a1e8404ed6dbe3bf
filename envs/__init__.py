"""Tactile grasping environments behind Gymnasium's interface.

`make("shadow", layout="4")` is the Shadow Hand in MuJoCo, `make("mpl")` the MPL hand in
PyBullet, `make("allegro")` a hand with four fingers, and `simulator=` swaps; `make`
also takes the id of any registered Gymnasium environment. The same environments are
registered as tactilerl/Shadow-v0, tactilerl/MPL-v0 and so on. A simulator is imported
when an environment that uses it is made.
"""

from __future__ import annotations

if __name__ == "envs":  # found by its folder: all of it would be there twice
    raise ImportError("envs is part of tactilerl: import tactilerl.envs")

import traceback
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from . import hands, plugins, scenes, validation
from .validation import nearest, require_known

if TYPE_CHECKING:
    from .batch import BatchEnv

TOYS = {"lqr": "tactilerl/LQR-v0", "point-reach": "tactilerl/PointReach-v0"}


class UnexpectedKeyword(TypeError, ValueError):
    """A keyword that no environment of that name takes: an error as Python has it, of one line."""


def make(
    name: str | None = None,
    *,
    scene: str | None = None,
    render_mode: str | None = None,
    **choices: Any,
) -> gym.Env[Any, Any]:
    """Return an environment by name.

    `name` is one of the library's hands or the path of a hand's .toml file (`choices`
    are then fields of `grasp.GraspConfig`), a toy ("lqr", "point-reach"), or a
    Gymnasium id. `scene` is a named scene (`scenes.names`) or its file; `name` and
    `choices` then change what it says. Raise ValueError when there is none of that
    name.
    """
    validation.require_type(name, str | None, "env")
    if scene is not None:
        name, choices = _of_scene(scene, name, choices)
    if name is None:
        raise ValueError("found neither the name of an environment nor a scene")
    if hands.is_hand(name):
        return _make_grasp(name, render_mode, choices)
    if render_mode is not None:
        choices["render_mode"] = render_mode
    module, colon, _ = name.partition(":")
    if colon:  # "my_module:MyEnv-v0"
        plugins.import_modules([module])
    try:
        return gym.make(TOYS.get(name, name), **choices)
    except gym.error.Error as error:
        known = (*hands.names(), *TOYS)
        hint = nearest(name, known)
        if name in scenes.names():
            id = scenes.gymnasium_id(name)
            hint = f"did you mean scene={name!r} (--scene {name}), or the id {id}? "
        reason = str(error).strip().splitlines()[0]
        raise ValueError(
            f"unknown environment {name!r}; {hint}allowed: {', '.join(known)}, a hand's .toml file, a "
            f"Gymnasium id, or MODULE:ID ({reason})"
        ) from None
    except (ValueError, OSError, RuntimeError):  # say what is wrong
        raise
    except Exception as error:  # of an environment that is not ours
        line = traceback.extract_tb(error.__traceback__)[-1].line
        reason = f"{type(error).__name__}: {str(error) or line}"  # of an assertion
        raise ValueError(f"env: {name!r} cannot be made here ({reason})") from error


def make_vec(
    name: str | None = None,
    *,
    scene: str | None = None,
    num_envs: int = 1,
    layouts: Sequence[str | int] = (),
    device: str = "cuda",
    autoreset: bool = True,
    **choices: Any,
) -> BatchEnv:
    """Return many worlds of a hand or scene, played at once: a Gymnasium VectorEnv of PyTorch tensors.

    The worlds are shared out evenly between `layouts` (none: the scene's own). `device`
    is PyTorch's, for MuJoCo Warp, or "loop", which is exact and slow; `autoreset` is
    that of `batch.BatchEnv`. The rest is as in `make`.

    Raise ValueError for what cannot be.
    """
    from .batch import BatchEnv
    from .grasp import setup

    if scene is not None:
        name, choices = _of_scene(scene, name, choices)
    if name is None or not hands.is_hand(name):
        raise ValueError(f"env: found {name!r} in a batch, allowed: {hands.allowed()}")
    config = setup(name, **choices)
    shared = [replace(config, layout=str(layout)) for layout in layouts] or [config]
    if num_envs < (n := len(shared)):
        raise ValueError(f"num_envs: found {num_envs}, allowed from {n}, one a layout")
    groups = [(each, (num_envs + i) // n) for i, each in enumerate(shared)]
    return BatchEnv(name, groups, device, autoreset)


def _of_scene(
    scene: str, name: str | None, choices: dict[str, Any]
) -> tuple[str, dict[str, Any]]:
    """Return the hand of a named scene, and its choices with these instead of some."""
    named = scenes.load(scene)
    name = name or named.env
    if not hands.is_hand(name):
        raise ValueError(
            f"env: found {name!r} with a scene, allowed: {hands.allowed()}"
        )
    return name, {**named.on(name), **choices}


def _make_grasp(
    hand: str, render_mode: str | None, choices: dict[str, Any]
) -> gym.Env[Any, Any]:
    """Return the environment of a hand; raise UnexpectedKeyword for a choice that there is not."""
    from .grasp import GraspConfig, GraspEnv, setup

    fields = validation.names(GraspConfig)
    unknown = [choice for choice in choices if choice not in fields]
    try:
        require_known(unknown, fields)
    except ValueError as error:
        python = f"got an unexpected keyword argument {unknown[0]!r}"
        raise UnexpectedKeyword(f"{error} ({python})") from None
    return GraspEnv(hand, setup(hand, **choices), render_mode)


# No wrapper may hide `compute_reward`.
_register = partial(gym.register, order_enforce=False, disable_env_checker=True)


def _register_ours(id: str, **kwargs: Any) -> None:
    """Register an environment of ours, and its batch: Gymnasium gives those no wrappers."""
    _register(id, "tactilerl.envs:make", kwargs=kwargs)
    batch = id.replace("-v", "Batch-v")
    _register(batch, vector_entry_point="tactilerl.envs:make_vec", kwargs=kwargs)


for _hand in hands.HANDS:
    _register_ours(hands.described(_hand).environment["id"], name=_hand)
for _scene in scenes.names():
    _register_ours(scenes.gymnasium_id(_scene), scene=_scene)
_register("tactilerl/PointReach-v0", "tactilerl.envs.toy:PointReachEnv")
gym.register("tactilerl/LQR-v0", "tactilerl.envs.toy:LQREnv")
