"""`--sensor`, from train to evaluate, and `env --fit-sensor`."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from tactilerl.commands.cli import main
from tactilerl.envs import sensors, vector

from one_line import PPO, REACH, fails_with, printed

pytestmark = pytest.mark.usefixtures("in_tmp")
TRAIN = ["train", *PPO, "--env", "shadow", *REACH]
EVALUATE = ["evaluate", "run", "--episodes", "1", "--workers", "1", "--json"]


def test_a_run_keeps_the_numbers_of_its_sensor_and_is_evaluated_with_others(capsys):
    mine = "[sensor]\nthreshold_N = 0.3\nradius_mm = 3\ndead = 0.5\ndelay_ms = 800\n"
    Path("mine.toml").write_text(mine)
    train = [*TRAIN, "--sensor", "mine.toml", "--taxel-dead", "0", "--total-timesteps"]
    assert main([*train, "12", "--out", "run"]) == 0
    saved = json.loads(Path("run/config.json").read_text())["scene"]
    assert (saved["sensor"], saved["taxel_threshold"], saved["taxel_delay"]) == ("mine.toml", 0.3, 4)
    assert (saved["taxel_radius"], saved["taxel_dead"]) == (0.003, 0.0)  # a flag overrules
    Path("mine.toml").unlink()  # the run needs it no more
    assert main(["train", "--resume", "run", "--total-timesteps", "24"]) == 0
    assert "sensors" not in json.loads(printed(capsys, EVALUATE))
    other = json.loads(printed(capsys, [*EVALUATE, "--sensor", "switch", "--taxel-dead", "1"]))
    numbers = {"threshold": 0.98, "release": 0.2, "threshold_spread": 0.1, "delay": 0, "dead": 1.0}
    told = {f"taxel_{name}": number for name, number in numbers.items()}
    assert other["sensors"] == {"sensor": "switch", **told}
    usual = {"sensor": "", "taxel_threshold": None, "taxel_radius": None, "taxel_delay": 0}
    assert json.loads(printed(capsys, [*EVALUATE, "--sensor", ""]))["sensors"] == usual
    blind = json.loads(printed(capsys, [*EVALUATE, "--touch", "off"]))["sensors"]
    assert (blind["touch"], blind["taxel_threshold"], blind["taxel_delay"]) == ("off", None, 0)


def test_what_a_sensor_does_not_say_and_what_is_too_firm_is_said_at_once(capsys, monkeypatch):
    """Before anything is played, where somebody interrupts."""

    def interrupt(*args):
        raise KeyboardInterrupt

    scene = ["--scene", "handover", "--sensor"]
    unknown = "note: eflesh names no threshold: its taxels fire at any contact"
    firm = "note: threshold 0.98 N is above --giver-force 0.32 N: touch comes too late"
    with monkeypatch.context() as patch:
        patch.setattr(vector, "start", interrupt)
        assert main(["gate", *scene, "switch"]) == 130
        assert capsys.readouterr().err.startswith(firm)
        for sensor, note in (("eflesh", unknown), ("switch", firm)):
            assert main(["design", *scene, sensor, "--taxels", "1"]) == 130
            assert capsys.readouterr().err.startswith(note)
    assert "fsr                  Force-sensing resistor, 8 mm" in printed(capsys, ["env"])
    assert unknown in printed(capsys, ["env", *scene, "eflesh"])
    for known in (["--taxel-threshold", "0.1"], ["--touch-rule", "force"], ["--touch", "off"]):
        assert "eflesh names" not in printed(capsys, ["env", *scene, "eflesh", *known])
    four = [*scene, "eflesh", "--layout", "5", "--taxel-dead", "0.02", "--taxel-stuck", "0.1"]
    assert "note: taxel_dead 0.02: none of 19 taxels is dead\nnote: e" in printed(
        capsys, ["env", *four]
    )
    spread = ["env", *scene, "eflesh", "--taxel-threshold-spread", "0.1"]
    fails_with(capsys, spread, "taxel_threshold_spread: found without a threshold, which it spreads")
    assert main([*TRAIN, "--sensor", "eflesh", "--total-timesteps", "12", "--out", "run"]) == 0
    assert "eflesh names no threshold" in " ".join(capsys.readouterr().out.split())
    assert main(EVALUATE) == 0
    assert capsys.readouterr().err.startswith(unknown)


def log(threshold, release, delay, noise, seed, is_boolean=False, n=15, dt=0.004):
    """Return (lines, 3) of a sensor in which it is pressed n times, slowly and fast."""
    rng = np.random.default_rng(seed)
    parts = [np.zeros(round(2 / dt))]
    for _ in range(n):
        rise = np.arange(0, rng.uniform(2, 4), rng.uniform(0.5, 8) * dt)
        parts += [rise, np.full(round(0.3 / dt), rise[-1]), rise[::-1], np.zeros(round(1 / dt))]
    force = np.concatenate(parts)
    time = dt * np.arange(len(force))
    felt, fires = np.interp(time - delay, time, force), np.zeros(len(force))
    for i in range(1, len(force)):
        fires[i] = felt[i] >= (release if fires[i - 1] else threshold)
    reading = (
        fires if is_boolean else 100 - 30 * (fires * felt + noise * rng.standard_normal(len(felt)))
    )
    return np.column_stack([time, force + 0.002 * rng.standard_normal(len(felt)), reading])


def write(name, rows, header="time,force_N,reading"):
    np.savetxt(name, rows, delimiter=",", header=header, comments="", fmt="%.6g")


def fitted(capsys, *names):
    """Return what the command prints: [sensor], and the intervals."""
    text = printed(capsys, ["env", "--fit-sensor", *names])
    lines = [line.split("  # 95 %: ") for line in text.splitlines() if "#" in line]
    bounds = {line.split(" = ")[0]: [float(x) for x in b.split(" to ")] for line, b in lines}
    Path("fitted.toml").write_text(text)
    sensors.load("fitted.toml")  # it can be given as --sensor
    return tomllib.loads(text)["sensor"], bounds


def test_a_fit_gives_back_the_numbers_of_simulated_logs(capsys):
    scale = [0.8, 1.0, 1.05, 1.1, 1.35]
    for number, s in enumerate(scale):
        write(f"{number}.csv", log(0.3 * s, 0.2 * s, delay=0.03, noise=0.02, seed=number))
    found, bounds = fitted(capsys, *(f"{number}.csv" for number in range(5)))
    true = {
        "threshold_N": 0.3 * np.mean(scale),
        "release_N": 0.2 * np.mean(scale),
        "delay_ms": 30,
        "threshold_spread": np.std(scale, ddof=1) / np.mean(scale),
        "noise_N": 0.02,
    }
    assert found == pytest.approx(true, rel=0.06)
    assert all(low <= found[key] <= high for key, (low, high) in bounds.items())
    assert bounds.keys() == true.keys() - {"noise_N"}
    assert bounds["threshold_N"][1] - bounds["threshold_N"][0] > 0.06  # from specimen to specimen
    write("switch.csv", log(0.98, 0.2, delay=0.01, noise=0.0, seed=9, is_boolean=True))
    found, _ = fitted(capsys, "switch.csv")  # one specimen tells no spread, a bit no noise
    true = {"threshold_N": 0.98, "release_N": 0.2, "delay_ms": 10}
    assert found == pytest.approx(true, rel=0.15)


def broken(rows, **changes):
    rows = rows.copy()
    for name, change in changes.items():
        column = ("time", "force", "reading").index(name)
        rows[:, column] = change(rows[:, column])
    return rows


GOOD = log(0.3, 0.2, delay=0.02, noise=0.02, seed=0)


@pytest.mark.parametrize(
    ("rows", "header", "said"),
    [
        (GOOD, "time,force_g,reading", "columns: found 'time,force_g,reading', allowed time,force_N"),
        (broken(GOOD, time=lambda t: 1e3 * t), None, "time: found steps of 4 s and more"),
        (broken(GOOD, force=lambda f: 0 * f), None, "found no press of 0.05 N"),
        (broken(GOOD, force=lambda f: f + 1.5), None, "the force at rest is 1.5 N: tare it"),
        (broken(GOOD, reading=lambda r: 0 * r), None, "the reading never leaves its rest"),
        (broken(GOOD, reading=lambda r: np.where(r == r.max(), np.nan, r)), None, "found NaN"),
        (
            log(0.3, 0.2, 0.45, 0.02, seed=0),
            None,
            "the reading changes after the force has come to rest",
        ),
        (GOOD[480:], None, "found less than 1 s of rest"),
        (GOOD[:2], None, "lines: found 2"),
        (broken(GOOD, force=lambda f: 1e3 * f), None, "N, allowed up to 100 N"),
    ],
)
def test_a_log_that_does_not_tell_is_one_line(rows, header, said, capsys):
    write("log.csv", rows, header or "time,force_N,reading")
    line = fails_with(capsys, ["env", "--fit-sensor", "log.csv"], said)
    assert line.startswith("tactilerl: error: log log.csv: ")
    assert [path.name for path in Path().iterdir()] == ["log.csv"]


def test_other_logs_are_one_line(capsys):
    Path("log.csv").write_text("time,force_N,reading\n0,0,much\n1,0,0\n2,0,0\n")
    fails_with(capsys, ["env", "--fit-sensor", "log.csv"], "could not convert string 'much' to float")
    fails_with(capsys, ["env", "--fit-sensor", "none.csv"], "No such file or directory: 'none.csv'")
    same = log(0.3, 0.2, delay=0.0, noise=0.0, seed=0, n=1)
    rest = same[round(2 / 0.004) :]
    whole = np.vstack([same[:500], *[rest] * 4])
    whole[:, 0] = 0.004 * np.arange(len(whole))
    write("log.csv", whole)
    fails_with(capsys, ["env", "--fit-sensor", "log.csv"], "allowed slow and fast ones")
