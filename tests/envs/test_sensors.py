"""Sensors as files: what they say, what they refuse, and what their numbers do."""

import re

import pytest

from tactilerl.envs import sensors


def test_sensors_of_the_library_say_where_their_numbers_are_from():
    assert len(sensors.names()) >= 8
    for name in sensors.names():
        sensor = sensors.load(name)
        assert sensor.name == name
        assert sensor.about
        assert len(sensor.source) > 20
    assert sensors.load("icub_fingertip").threshold == 0.05
    assert sensors.load("icub_fingertip_field").threshold == 2.5


def test_a_file_is_read_in_si_units_and_what_it_lacks_is_unknown(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        "[sensor]\nradius_mm = 4\nthreshold_N = 0.3\nrelease_N = 0.2\ndelay_ms = 20\n"
        "drift_N_per_min = 0.1\n[cost]\neach = 6\nboard = 40\nchannels = 16\n"
    )
    mine = sensors.load(path)
    assert (mine.name, mine.threshold, mine.release, mine.drift) == ("mine", 0.3, 0.2, 0.1)
    assert (mine.radius, mine.delay) == pytest.approx((0.004, 0.02))
    assert mine.noise is mine.dead is mine.gain_spread is None
    assert mine.cost == sensors.Cost(6.0, 40.0, 16)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("threshold = 0.1", r"sensor.threshold: unknown; did you mean threshold_N\?"),
        ("radius_mm = -1", r"sensor.radius_mm: found -1.0, allowed \[0.1, 20\]"),
        ("threshold_N = nan", "sensor.threshold_N: found nan, allowed"),
        ("delay_ms = '20'", "sensor.delay_ms: found '20', allowed a number or None"),
        ("threshold_N = 0.1\nrelease_N = 0.2", "release_N: found 0.2, allowed up to threshold_N, 0.1"),
        ("release_N = 0.2", "release_N: found without threshold_N"),
        ("dead =", "not valid TOML"),
        ("[cost]\nboard = 40", "cost.each: found None, allowed a number"),
        ("[cost]\neach = 1\nchannels = 0", r"cost.channels: found 0, allowed \[1, 100000\]"),
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
    with pytest.raises(ValueError, match=r"sensor: found 'fsr2', allowed: biotac, .*, FILE.toml"):
        sensors.load("fsr2")
    with pytest.raises(FileNotFoundError, match="sensor file 'none.toml' does not exist"):
        sensors.load("none.toml")
    (tmp_path / "empty.toml").write_text("")
    with pytest.raises(ValueError, match="sensor: found None, allowed a table"):
        sensors.load(tmp_path / "empty.toml")
