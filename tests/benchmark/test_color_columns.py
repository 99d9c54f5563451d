import pytest

from dudmap.config import Config
from dudmap.errors import ConfigError
from dudmap.lab.benchmark import measure
from dudmap.lab.benchmark.color_columns import color_table, measure_columns
from dudmap.lab.benchmark.suites import SENSORS, Entry, sensor_entries
from dudmap.lab.synthetic.sensors import CAMERAS

TINY = {"scene": "box", "movers": (), "frames": 2, "camera": (64, 48), "noise": "none"}


def rows(name, with_color, without, default):
    values = {"with colour": with_color, "without colour": without, "default": default}
    return [{"sequence": name, "system": system, "ate_rmse_m": value, "lost": 0} for system, value in values.items()]


def test_default_must_be_within_five_percent_of_the_better_column():
    for default, within in ((0.0104, "1.04 | yes"), (0.0106, "1.06 | NO"), (0.008, "0.80 | yes")):
        line = color_table(rows("a", 0.02, 0.01, default)).splitlines()[2]
        assert line == f"| a | 20.0 | 10.0 | {1000 * default:.1f} | 10.0 | {within} |"
    lost = color_table([row | {"lost": 3} for row in rows("a", 0.02, None, 0.01)])
    assert "| a | 20.0 (3 lost) |  (3 lost) | 10.0 (3 lost) | 20.0 |  |  |" in lost


def test_failed_column_is_named_and_passes_nothing():
    found = rows("a", 0.02, 0.01, 0.01)
    found[1] = {"sequence": "a", "system": "without colour", "error": "no frame was tracked"}
    text = color_table(found)
    assert "| failed | 10.0 | 20.0 |  |  |" in text
    assert "- a, without colour: no frame was tracked" in text


def test_only_the_default_calibrates_and_a_failed_column_is_a_row(monkeypatch):
    def measure_job(function, job):
        if job.config.tracker.color_weight == 0:
            return {"error": "no frame was tracked"}
        return {"sigma": job.config.sensor.color_time_sigma, "calibrated": job.calibrate}

    monkeypatch.setattr(measure, "in_own_process", measure_job)
    found = {row["system"]: row for row in measure_columns([Entry("tiny", parameters=TINY)], Config())}
    assert found["with colour"]["sigma"] == 0
    assert not found["with colour"]["calibrated"]
    assert found["without colour"]["error"] == "no frame was tracked"
    assert found["default"]["sigma"] == Config().sensor.color_time_sigma
    assert found["default"]["calibrated"]


def test_suite_takes_one_room_with_every_sensor():
    entries = {entry.name: entry for entry in sensor_entries()}
    assert set(entries) == set(SENSORS)
    assert set(CAMERAS) <= set(entries)
    assert {entry.parameters["camera"] for entry in sensor_entries(quick=True)} == {(320, 240)}
    small = {"frames": 2, "camera": (64, 48)}
    delayed = Entry("a", parameters={**entries["delay"].parameters, **small}).open()
    assert delayed.faults.color_delay == 0.025
    named = Entry("b", parameters={**entries["kinect_v2"].parameters, **small}).open()
    assert named.faults == CAMERAS["kinect_v2"].faults
    with pytest.raises(ConfigError, match="unknown sensor of the suite 'eye'; known are clean"):
        sensor_entries(["eye"])
