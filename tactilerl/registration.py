"""`import tactilerl` is enough for `gymnasium.make("tactilerl/Shadow-v0")`, and imports nothing.

The environments are registered by `tactilerl.envs`, which imports Gymnasium. Here that waits
until somebody imports Gymnasium anyway, before or after this package. (Gymnasium 1.x loads no
entry points.)
"""

from __future__ import annotations

import sys

TYPE_CHECKING = False  # typing's own would be most of what `import tactilerl` costs
if TYPE_CHECKING:
    from importlib.machinery import ModuleSpec
    from types import ModuleType
    from typing import Any


class _WhenGymnasiumIsImported:
    """A finder that leaves finding to the usual one and has our environments registered afterwards."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        if name != "gymnasium":
            return None
        from importlib.machinery import PathFinder

        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module: ModuleType) -> None:
                execute(module)
                sys.meta_path.remove(self)
                from . import envs  # noqa: F401

            spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec


if "gymnasium" in sys.modules:
    from . import envs  # noqa: F401
else:
    sys.meta_path.insert(0, _WhenGymnasiumIsImported())
