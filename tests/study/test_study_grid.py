"""Study files: what they stand for, and one line for everything that is wrong with them."""

import json
from pathlib import Path

import pytest
from tactilerl.study import grid

from one_line import fails_with
from tiny_study import write

ROOT = Path(__file__).resolve().parents[2]
GOOD = (ROOT / "tests/studies/two_setups.toml").read_text()
SIZES = "batch_size = [16, 32]"


def read(tmp_path, text):
    return grid.read(write(tmp_path, text))


class TestGrid:
    def test_runs_are_balanced_at_any_time(self, tmp_path):
        runs = read(tmp_path, GOOD).runs()
        assert [run.seed for run in runs] == [0] * 4 + [3] * 2 + [1] * 4 + [7] * 4
        assert runs[0].name == "reach_batch_size-16_polyak-0.9_s0"
        assert len({run.name for run in runs}) == len(runs) == 14

    def test_flags_become_those_of_train(self, tmp_path):
        study = read(tmp_path, GOOD)
        configs = {run.name: run.config() for run in study.runs()}
        first, ppo = configs["reach_batch_size-16_polyak-0.9_s1"], configs["ppo_n_passes-4_s3"]
        assert (first.run.algo, first.run.env, first.run.seed) == ("ddpg_her", "point-reach", 1)
        assert (first.learner.batch_size, first.learner.polyak) == (16, 0.9)
        assert (ppo.learner.anneal_lr, ppo.learner.hidden, ppo.learner.n_passes) == (True, (16, 16), 4)
        assert first.run.workers == 1

    def test_a_recipe_is_a_flag_like_others(self, tmp_path):
        text = GOOD.replace("grid = {n_passes", 'recipe = "steady"\ngrid = {n_passes')
        (ppo,) = (run.config().learner for run in read(tmp_path, text).runs() if "passes-4" in run.name)
        assert (ppo.exploration, ppo.hidden, ppo.n_passes) == ("learned", (16, 16), 4)

    def test_dictionary_and_back(self, tmp_path):
        decided = read(tmp_path, 'score = "last"\n' + GOOD[: GOOD.index("[setups.ppo]")])
        data = json.loads(json.dumps(decided.as_dict()))
        assert grid.from_dict(data) == decided
        assert (read(tmp_path, GOOD).score, decided.score) == ("area", "last")
        old = {"name": "x", "setups": data["setups"], "primary": {"score": "final"}}  # of 0.5.0
        assert grid.from_dict(old).score == "last"

    @pytest.mark.parametrize("name", sorted(path.stem for path in ROOT.glob("studies/*.toml")))
    def test_the_studies_of_the_project_can_be_configured(self, name):
        study = grid.read(ROOT / "studies" / f"{name}.toml")
        runs = study.runs()
        for run in [run for run in runs if run.seed in (0, 20000)]:
            run.config()
        assert name != "paper" or len(runs) == 240


class TestBadFiles:
    @pytest.mark.parametrize(
        ("old", "new", "words"),
        [
            ('name = "toy"', "", ["name", "None"]),
            ('name = "toy"', "name = ", ["not valid TOML", "line 2"]),
            ('name = "toy"', 'name = "toy"\ngird = 1', ["gird: unknown; did you mean grid?"]),
            ('name = "toy"', 'name = "toy"\nscore = "best"', ["score: found 'best'", "area, last"]),
            (SIZES, "batch_size = [16, 16]", ["2 runs would be called"]),
            (SIZES, "batch-size = [16, 32]", ["batch-size: unknown; did you mean batch_size?"]),
            (SIZES, "batch_size = [16, 0]", ["batch_size-0", "batch_size: found 0"]),
            (SIZES, "workers = [1, 2]", ["setups.reach: workers", "leave it out"]),
            ('"0-1, 7"', '"0-1, x"', ["seed: found ' x', expected numbers and ranges"]),
            ('"0-1, 7"', '"0-4000000000"', ["seed: found '0-4000000000', allowed 100,000 seeds"]),
            ('"0-1, 7"', '"0-99999999999999999999999"', ["seed: found", "allowed 100,000 seeds"]),
            (SIZES, f'layout = ["{300 * "x"}"]', ["grid: found a name of 3", "allowed 245: 'reach_"]),
            (GOOD, 'name = "toy"\n[setups]', ["setups: found none, allowed one or more"]),
            ('algo = "ddpg_her"', 'scen = "handover"', ["scen: unknown; did you mean scene?"]),
            ("polyak = [0.95, 0.9]", "polyak = [0.95, 0.8]", ["compare: polyak", "0.8"]),
            ("polyak = [0.95, 0.9]", "layout = [1, 2]", ["compare: found 'layout'", "batch_size"]),
            ('algo = "ddpg_her"', 'algo = "ddpg_her"\npolyak = 0.9', ["polyak", "and in the grid"]),
            ('algo = "ddpg_her"', 'algo = "ddpg_her"\nseed = 3', ["setups.reach: seed", "grid"]),
            ('"test_success_rate"', '"mean_return"', ["measure", "mean_return", "success_rate"]),
        ],
    )  # fmt: skip
    def test_one_line_and_nothing_begun(self, tmp_path, capsys, old, new, words):
        assert old in GOOD
        file = write(tmp_path, GOOD.replace(old, new))
        fails_with(capsys, ["study", "run", file, "--out", tmp_path / "out"], *words)
        assert not (tmp_path / "out").exists()

    def test_what_cannot_be_read_or_made(self, tmp_path, capsys, in_tmp):
        fails_with(capsys, ["study", "run", tmp_path / "none.toml"], "does not exist")
        study = write(tmp_path, 'name = "x"\n[setups.x]\nenv = "lqr"\nhidden = [8]\n')
        fails_with(capsys, ["study", "run", study, "--out", study / "out"], "cannot write")
        fails_with(capsys, ["study", "run", study, "--jobs", 0], "jobs: found 0")
