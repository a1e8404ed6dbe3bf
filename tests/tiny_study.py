"""A study of two short runs, for tests of who runs it."""

from tactilerl.study import analysis, records, report, tables

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
total_timesteps = 200
"""


def write(tmp_path, text=TINY):
    path = tmp_path / "study.toml"
    path.write_text(text)
    return path


def learned(folder):
    """Every table that depends on nothing but what was learned, as bytes: the same however often the
    study was cut off, on any machine of the kind."""
    result = analysis.analyse(*records.load(folder), 200)
    return {
        table.name: table.csv()
        for section in report.sections(result)
        for table in section.parts
        if isinstance(table, tables.Table) and table.name not in ("cost", "versions")
    }
