"""Show the progress of a run: a line for each epoch, and events for TensorBoard."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from ..algos.learner import Learner
from ..algos.mpi import Communicator
from ..algos.rollout import FAULTS
from ..errors import extra
from .console import about


class EpochLog:
    """Print a line for each epoch; write TensorBoard events to a folder when given one."""

    def __init__(
        self,
        learner: Learner,
        comm: Communicator,
        events: Path | None = None,
        is_quiet: bool = False,
        earlier: Sequence[Mapping[str, Any]] = (),
    ) -> None:
        """Begin where `learner` is; `events` is the folder. Ranks but the first print nothing.

        Events of `earlier` rows are written anew: those of another process may lack its
        last ones.
        """
        self.console = Console(
            quiet=is_quiet or comm.rank > 0,
            highlight=False,
            soft_wrap=True,
            markup=False,
        )
        self.total, self._first_step = learner.total_timesteps, learner.env_steps
        self._started = time.perf_counter()
        self._events: Any = None
        if events is not None and comm.rank == 0:
            first = 0 if earlier else None  # step from which older events are hidden
            self._events = require_tensorboard()(str(events), purge_step=first)
            for row in earlier:
                self._write_events(row)

    def close(self) -> None:
        """Close the file of events."""
        if self._events is not None:
            self._events.close()

    def epoch(self, row: Mapping[str, Any]) -> None:
        """Print one row of the progress table."""
        steps, text = row["env_steps"], f"success {_percent(row['success_rate'])}  "
        if "test_success_rate" in row:
            text += f"test {_percent(row['test_success_rate'])}  "
        if (final := row.get("final_test_success_rate", "")) != "":
            text += f"final test {_percent(final)}  "
        spent = time.perf_counter() - self._started
        left = spent * max(0, self.total - steps) / (steps - self._first_step)
        text += f"return {row['mean_return']:.1f}  {row['steps_per_s']:.0f} steps/s  "
        for fault in FAULTS:
            if times := row.get(fault, 0.0) + row.get(f"test_{fault}", 0.0):
                text += f"{fault} {times:.0f}  "
        done = f"epoch {row['epoch']:4d}  steps {steps:,}/{self.total:,}"
        self.console.print(f"{done}  {text}{about(left)} left")
        if self._events is not None:
            self._write_events(row)

    def _write_events(self, row: Mapping[str, Any]) -> None:
        """Write a row of the progress table for TensorBoard."""
        for column, value in row.items():
            is_known = value != "" and not math.isnan(value)
            if is_known and column not in ("epoch", "env_steps"):
                self._events.add_scalar(f"train/{column}", value, int(row["env_steps"]))
        self._events.flush()


def _percent(value: float) -> str:
    return "  –  " if math.isnan(value) else f"{100 * value:4.0f}%"


def require_tensorboard() -> Any:
    """Return the class that writes events; InputError naming the extra when it is not installed."""
    with extra("tensorboard"):
        from torch.utils.tensorboard import SummaryWriter
    return SummaryWriter
