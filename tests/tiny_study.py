"""A study of two short runs, for tests of who runs it, and one of two set-ups, for tests of files."""

from contextlib import redirect_stderr, redirect_stdout

import pytest
from tactilerl.commands.cli import main
from tactilerl.study import analysis, jobs, records, report

TINY = """
name = "tiny"
measure = "test_success_rate"
[compare]
polyak = [0.95, 0.9]
[grid]
polyak = [0.9, 0.95]
seed = 0
[setups.reach]
algo = "ddpg_her"
recipe = "paper"  # of which a run that goes on hears again
env = "point-reach"
hidden = [8]
batch_size = 16
n_cycles = 1
n_batches = 2
n_test_rollouts = 1
n_test_episodes = 3
total_timesteps = 200
"""
GOOD = """
name = "toy"
[compare]
polyak = [0.95, 0.9]
[grid]
batch_size = [16, 32]
polyak = [0.9, 0.95]
seed = "0-1, 7"
[setups.reach]
algo = "ddpg_her"
env = "point-reach"
measure = "test_success_rate"
[setups.ppo]
env = "lqr"
anneal_lr = true
hidden = [16, 16]
compare = {n_passes = [4, 2]}
grid = {n_passes = [2, 4], seed = 3}
"""


def write(tmp_path, text=TINY):
    path = tmp_path / "study.toml"
    path.write_text(text)
    return path


def trained(path, text=TINY):
    """The study's folder, all runs done in this process, which is faster."""
    out = path / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jobs, "_process", in_this_process)
        assert main(["study", "run", str(write(path, text)), "--out", str(out), "--jobs", "1"]) == 0
    return out


def in_this_process(log_file, job):
    """Train a run by the command that it is always trained by, but without a process."""
    with open(log_file, "a") as log, redirect_stdout(log), redirect_stderr(log):
        return main(job.arguments)


def learned(folder):
    """Every table that depends on nothing but what was learned, as bytes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(analysis, "N_RESAMPLES", 200)
        result = analysis.analyse(*records.load(folder))
    return {
        table.name: table.csv()
        for *_, parts in report.sections(result)
        for table in parts
        if isinstance(table, report.Table)
    }
