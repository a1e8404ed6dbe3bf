"""Several processes: equal parameters on all ranks, one writer, no rank left waiting; in one launch."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tactilerl.algos import mpi

from one_line import fails_with
from states import flat

pytest.importorskip("mpi4py")
MPIRUN = Path(sys.executable).with_name("mpirun")
pytestmark = [
    pytest.mark.skipif(not MPIRUN.exists(), reason="no mpirun beside this Python (extra: mpi)"),
    pytest.mark.usefixtures("in_tmp"),
]
REACH = ["train", "--algo", "ddpg_her", "--env", "point-reach", "--hidden", "16", "--n-cycles", "2"]
REACH += ["--n-batches", "5", "--n-test-rollouts", "1"]
# Minibatches, and commands, in the last of which rank 1 sees what is no number.
LAUNCHED = """
import json, sys
import numpy as np, torch
from tactilerl import envs
from tactilerl.algos import mpi
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.replay import Batch
from tactilerl.commands.cli import main
from tactilerl.envs import vector
from tactilerl.envs.toy import PointReachEnv
comm, alone = mpi.world(), mpi.Communicator()
def vec(learner):
    return torch.cat([p.detach().ravel() for p in learner.actor_parameters + learner.critic_parameters])
assert comm.size == comm.local_size == 2
pool = vector.start(lambda: envs.make("point-reach"))
config = DDPGHERConfig(hidden=(32, 32), reduction="mean")
parts, whole = (DDPGHER(config, pool, world, 0, 1) for world in (comm, alone))
rng = np.random.default_rng(0)
for _ in range(50):
    shapes = (64, 4), (64, 2), (64, 2), (64,), (64, 4), (64,)
    batch = Batch(*(torch.from_numpy(rng.standard_normal(n).astype(np.float32)) for n in shapes))
    mine = slice(32 * comm.rank, 32 * comm.rank + 32)
    parts._update_networks(Batch(*(part[mine] for part in batch)))
    whole._update_networks(batch)
first, second = comm.all_gather(vec(parts))
assert torch.equal(first, second)
start = vec(DDPGHER(config, pool, alone, 0, 1))
moved = (vec(whole) - start).norm()
assert (vec(whole) - vec(parts)).norm() < 1e-3 * moved
# and the normalizer has seen one stream
for rows in 1e6 + rng.standard_normal((5, 2, 10, 2)):
    parts.goal_stats.update(rows[comm.rank])
    whole.goal_stats.update(rows.reshape(-1, 2))
np.testing.assert_allclose(parts.goal_stats.std, whole.goal_stats.std, rtol=1e-9)
print("two ranks equal one with all batches")
*sound, faulty = json.loads(sys.argv[1])
for command in sound:
    main(command)
step, actions = PointReachEnv.step, []
def broken(self, action):
    actions.append(action)
    obs, *rest = step(self, action)
    return {key: np.nan * value if len(actions) > 40 else value for key, value in obs.items()}, *rest
if comm.rank == 1:
    PointReachEnv.step = broken
main(faulty)
"""


@pytest.fixture(scope="module")
def launched(tmp_path_factory, launches):
    """The folder where LAUNCHED ran, and how it ended."""
    folder = tmp_path_factory.mktemp("launched")
    (folder / "check.py").write_text(LAUNCHED)
    commands = [
        [*REACH, "--total-timesteps", "400", "--out", "whole"],
        [*REACH, "--total-timesteps", "200", "--out", "parts"],
        ["train", "--resume", "parts", "--total-timesteps", "400"],
        [*REACH, "--out", "faulty"],
    ]
    command = [str(MPIRUN), "--oversubscribe", "-n", "2", sys.executable, "-m", "mpi4py", "check.py"]
    command += [json.dumps(commands)]
    with pytest.MonkeyPatch.context() as patch, launches:
        patch.chdir(folder)
        patch.setenv("PYTHONPATH", os.pathsep.join([str(folder), *sys.path]))
        return folder, subprocess.run(command, capture_output=True, text=True, timeout=900)


def test_gradients_averaged_over_two_ranks_are_those_of_one_with_twice_the_batch(launched):
    said = "two ranks equal one with all batches"
    assert launched[1].stdout.count(said) == 2, launched[1].stderr


def test_ranks_train_one_writes_and_resume_is_exact(launched):
    folder, result = launched
    assert result.stdout.count("The run is in whole") == 1, result.stderr
    assert json.loads((folder / "whole/config.json").read_text())["ranks"] == 2
    whole, parts = (
        torch.load(folder / run / "checkpoint.pt", weights_only=True)["ranks"]
        for run in ("whole", "parts")
    )
    assert [rank["env_steps"] for rank in whole] == 2 * [400]
    for a, b in zip(whole, parts, strict=True):
        assert flat(a) == flat(b)
    assert len(set(map(flat, whole))) == 1  # bit-equal parameters


def test_ppo_is_refused_in_one_line(monkeypatch, capsys):
    comm = mpi.Communicator()
    comm.size = 2
    monkeypatch.setattr(mpi, "world", lambda: comm)
    words = "ranks: found 2 with ppo, allowed 1; without mpirun, --workers plays on many cores"
    fails_with(capsys, ["train", "--env", "lqr"], words)
    assert not Path("runs").exists()


def test_a_fault_on_one_rank_ends_all_with_the_reason(launched):
    assert launched[1].returncode == 1, launched[1].stderr
    assert "observation of the environment is not finite" in launched[1].stderr


def test_another_number_of_ranks_is_refused(launched, capsys):
    words = "ranks: found 1, the run was made with 2"
    fails_with(capsys, ["train", "--resume", launched[0] / "whole", "--total-timesteps", "800"], words)


def test_a_launch_of_one_process_needs_no_mpi4py(monkeypatch):
    monkeypatch.setitem(sys.modules, "mpi4py", None)
    monkeypatch.setenv("PMIX_RANK", "0")
    assert mpi.world().size == 1
    monkeypatch.setenv("OMPI_COMM_WORLD_SIZE", "2")
    with pytest.raises(ImportError, match="mpi4py"):
        mpi.world()
