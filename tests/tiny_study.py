"""A study of two short runs, trained without a process for each."""

from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
from tactilerl.commands.cli import main
from tactilerl.study import analysis, jobs, records, report

TINY = (Path(__file__).parent / "studies/tiny.toml").read_text()


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
