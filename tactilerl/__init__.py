"""tactilerl: what is touch worth to a robot hand?

Hand-written PPO in PyTorch, and tactile grasping environments behind Gymnasium's interface.
`tactilerl.envs.make` makes an environment; the command `tactilerl` trains on it.
"""

from .registration import with_gymnasium

__version__ = "0.2.0.dev0"

with_gymnasium()
