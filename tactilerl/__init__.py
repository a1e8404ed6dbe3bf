"""tactilerl: what is touch worth to a robot hand?

Hand-written PPO and DDPG+HER in PyTorch, and tactile grasping environments behind
Gymnasium's interface; the command `tactilerl` trains on them, and so do the few names
here:

    env = tactilerl.make("shadow", layout=4)
    ppo = tactilerl.PPO(env, seed=0).learn(50_000, progress=True)

Each is imported when it is first used. `import tactilerl.envs`, and this package after
Gymnasium, registers the environments: `gymnasium.make("tactilerl/Shadow-v0")`.
"""

import sys

from .version import __version__ as __version__

if (
    "gymnasium" in sys.modules
):  # else it would be most of what importing this package costs
    from . import envs as envs

TYPE_CHECKING = False  # typing's own would be the rest
if TYPE_CHECKING:
    from typing import Any

    from .api import DDPGHER, PPO, design, evaluate, train
    from .envs import make, make_vec
    from .runs.policies import load_policy

__all__ = [
    "DDPGHER",
    "PPO",
    "design",
    "evaluate",
    "load_policy",
    "make",
    "make_vec",
    "train",
]

# No module of this package may have one of these names: importing it would hide the
# function.
_WHERE = {
    "envs": "envs",
    "make": "envs",
    "make_vec": "envs",
    "load_policy": "runs.policies",
}


def __getattr__(name: str) -> "Any":
    if name not in (*__all__, "envs"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    module = import_module(f".{_WHERE.get(name, 'api')}", __name__)
    return module if name == "envs" else getattr(module, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
