"""Sensors as files: what they say, what they refuse, and what their numbers do."""

import re
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tactilerl import envs
from tactilerl.envs import scenes, sensors
from tactilerl.envs.batch import BatchEnv
from tactilerl.envs.grasp import GraspConfig, GraspEnv, setup
from tactilerl.envs.observations import ForceErrors


def test_sensors_of_the_library_say_where_their_numbers_are_from():
    assert len(sensors.names()) >= 8
    for name in sensors.names():
        sensor = sensors.load(name)
        assert sensor.name == name
        assert sensor.about
        assert len(sensor.source) > 20
    fingertips = ("icub_fingertip", "icub_fingertip_field")
    assert [sensors.load(name).numbers["taxel_threshold"] for name in fingertips] == [0.05, 2.5]


def test_a_file_is_read_in_si_units_and_what_it_lacks_is_unknown(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        "[sensor]\nradius_mm = 4\nthreshold_N = 0.3\nrelease_N = 0.2\ndelay_ms = 20\n"
        "drift_N_per_min = 0.1\n[cost]\neach = 6\nboard = 40\nchannels = 16\n"
    )
    mine = sensors.load(path)
    known = {"radius": 0.004, "threshold": 0.3, "release": 0.2, "delay": 0.02, "drift": 0.1}
    assert mine.name == "mine"
    assert mine.numbers == pytest.approx({f"taxel_{name}": x for name, x in known.items()})
    assert mine.cost == sensors.Cost(6.0, 40.0, 16)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("threshold = 0.1", r"sensor.threshold: unknown; did you mean threshold_N\?"),
        ("radius_mm = -1", r"sensor.radius_mm: found -1.0, allowed \[0.1, 20\]"),
        ("threshold_N = nan", "sensor.threshold_N: found nan, allowed"),
        ("threshold_N = 0.1\nrelease_N = 0.2", "release_N: found 0.2, allowed up to threshold_N, 0.1"),
        ("dead =", "not valid TOML"),
        ("[cost]\nboard = 40", "cost.each: missing, allowed a number"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(tmp_path, content, said):
    path = tmp_path / "wrong.toml"
    path.write_text(f"[sensor]\n{content}\n")
    with pytest.raises(ValueError, match=said) as error:
        sensors.load(path)
    assert re.match(f"sensor file {re.escape(str(path))}: ", str(error.value))
    assert "\n" not in str(error.value)


def test_other_names_and_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"found 'fsr2', did you mean fsr\? .*, FILE\.toml"):
        sensors.load("fsr2")
    with pytest.raises(FileNotFoundError, match=r"sensor file 'no\.toml' does not exist"):
        sensors.load("no.toml")
    (tmp_path / "empty.toml").write_text("")
    with pytest.raises(ValueError, match="sensor: missing, allowed a table"):
        sensors.load(tmp_path / "empty.toml")


def taxels(config):
    return {k: v for k, v in vars(config).items() if k.startswith("taxel_")}


USUAL = taxels(GraspConfig())
FSR = {"taxel_saturates": 20.0, "taxel_gain_spread": 0.06, "taxel_radius": 0.00381}


@pytest.mark.parametrize(
    ("choices", "expected"),
    [
        ({"sensor": "fsr", "taxel_threshold": 0.0}, {"taxel_threshold": 0.0, "taxel_radius": 0.00381}),
        ({"sensor": "fsr", "touch_rule": "force"}, FSR),
        ({"sensor": "fsr", "touch": "off"}, {}),
        ({"sensor": "biotac", "control_dt": 0.004}, {"taxel_delay": 2}),
        ({"sensor": "tactile_genesis", "taxel_dead": 0.0}, {"taxel_dead": 0.0}),
    ],
)
def test_the_numbers_of_a_sensor_are_defaults_of_the_taxels_fields(choices, expected):
    config = setup("shadow", **choices)
    config.validate()
    found = taxels(config)
    assert {k: found[k] for k in expected} == expected
    if "biotac" not in choices.values():
        assert {k: v for k, v in found.items() if v != USUAL[k]}.keys() <= expected.keys()


def test_another_sensor_replaces_all_numbers_and_no_touch_takes_them_away():
    config = setup("shadow", sensor="switch", taxel_dead=0.5)
    other = sensors.choose(config, {"sensor": "tactile_genesis"})
    assert taxels(other) == {**USUAL, "taxel_dead": 0.05}
    assert taxels(sensors.choose(config, {"touch": "off"})) == USUAL
    assert sensors.choose(config, {"layout": "5"}).taxel_threshold == 0.98


def test_a_sensors_numbers_follow_what_they_depend_on_but_for_what_was_chosen(tmp_path):
    """As if all had been chosen at once."""
    own = str(tmp_path / "own.toml")
    Path(own).write_text("[sensor]\nthreshold_N = 0.3\nnoise_N = 0.005\ndelay_ms = 100\ndead = 0.5\n")
    config = setup("shadow", sensor=own, control_dt=0.1, taxel_dead=0.2)
    for change in (
        {"control_dt": 0.05},
        {"touch_rule": "force"},
        {"control_dt": 0.05, "taxel_delay": 1},
    ):
        at_once = setup("shadow", sensor=own, taxel_dead=0.2, **{"control_dt": 0.1, **change})
        assert sensors.choose(config, change) == at_once
    felt = sensors.choose(setup("shadow", sensor=own, touch="off"), {"touch": "on"})
    assert (felt.taxel_threshold, felt.taxel_dead) == (0.3, 0.5)
    Path(own).unlink()  # nothing changes, so it is not read
    assert sensors.choose(config, {"touch": "on", "layout": "5"}).taxel_threshold == 0.3


def thresholds(**choices):
    with closing(envs.make("mpl", simulator="mujoco", layout=1, **choices)) as env:
        return env.unwrapped._touch._thresholds, env.unwrapped._touch._releases


def test_thresholds_scatter_from_taxel_to_taxel_once_a_hand():
    choices = dict(taxel_threshold=0.3, taxel_release=0.2, taxel_threshold_spread=0.2)
    fires, stops = thresholds(**choices, hand_seed=1)
    assert fires.std() / 0.3 == pytest.approx(0.2, abs=0.04)
    assert fires.mean() == pytest.approx(0.3, abs=0.02)
    assert stops == pytest.approx(fires * 2 / 3)
    assert (fires == thresholds(**choices, hand_seed=1)[0]).all()
    assert (fires != thresholds(**choices, hand_seed=2)[0]).all()
    assert thresholds(**{**choices, "taxel_threshold_spread": 1.0})[0].min() == 0.0


def readings(forces, n_episodes=1, **choices):
    """Return what is told (episodes, steps, n) of forces (steps, n)."""
    config = setup("shadow", touch_rule="force", control_dt=6.0, **choices)
    stage = ForceErrors(config, forces.shape[1])
    told = []
    for episode in range(n_episodes):
        stage.reset(np.random.default_rng(episode))
        told.append([stage(force) for force in forces])
    return np.array(told)


def test_forces_are_told_with_the_errors_of_their_sensors():
    forces = np.full((50, 400), 2.0)
    assert (readings(forces) == forces).all()
    assert (readings(forces, taxel_saturates=1.5) == 1.5).all()
    gains = readings(forces, 2, taxel_gain_spread=0.1) / 2.0
    assert (gains == gains[0, 0]).all()  # the hand's
    assert gains[0, 0].std() == pytest.approx(0.1, abs=0.01)
    noise = readings(forces, 2, taxel_noise=0.3) - 2.0
    assert noise.std() == pytest.approx(0.3, rel=0.02)
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.03
    drift = readings(2.0 * forces, 2, taxel_drift=0.5) - 4.0  # 0.05 N in 6 s
    assert np.abs(drift[:, -1]) == pytest.approx(49 * 0.05)
    assert {*np.sign(drift[0, -1])} == {-1.0, 1.0}
    assert (drift[0] == drift[1]).all()
    assert readings(0.0 * forces, taxel_noise=0.3).min() == 0.0  # nothing is below 0


def test_a_policy_is_told_the_errors_and_the_state_keeps_the_truth():
    choices = dict(scene="handover", touch_rule="force", history=1)
    with closing(envs.make(**choices, taxel_noise=0.1)) as env:
        obs, _ = env.reset(seed=0)
        assert obs["observation"][env.unwrapped.observation_entries("taxels")].max() > 0.0
        assert (env.unwrapped.taxel_readings() == 0.0).all()
        assert env.observation_space.contains(obs)


@pytest.mark.parametrize(
    ("choices", "hand_seeds"),
    [
        (dict(touch_rule="force", taxel_noise=0.1, taxel_gain_spread=0.2, taxel_drift=5.0), [1, 2]),
        (dict(taxel_threshold=0.2, taxel_threshold_spread=0.5), [1, 2]),
        (dict(sensor="tactile_genesis", touch_rule="force", taxel_saturates=0.004), [None, None]),
    ],
)
def test_a_batch_is_told_what_one_environment_is_told(choices, hand_seeds):
    scene = scenes.load("handover").on("mpl")
    first = setup("mpl", **{**scene, "simulator": "mujoco", "layout": "1", **choices})
    groups = [(replace(first, hand_seed=seed), 1) for seed in hand_seeds]
    batch = BatchEnv("mpl", groups, "loop", autoreset=False)
    singles = [GraspEnv("mpl", config) for config, _ in groups]
    wait = np.full(1, -0.2)
    together = [batch.reset(seed=[10, 9])[0]]
    together += [batch.step(np.array([wait, wait]))[0] for _ in range(25)]
    for number, env in enumerate(singles):
        alone = [env.reset(seed=10 - number)[0]] + [env.step(wait)[0] for _ in range(25)]
        told = [obs["observation"] for obs in alone]
        assert np.array(told)[:, env.observation_entries("taxels")].any()
        found = [obs["observation"][number].numpy() for obs in together]
        np.testing.assert_allclose(found, told, atol=1e-5)
        env.close()
    batch.close()
