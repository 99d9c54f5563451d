import pytest

from dudmap.config import Config
from dudmap.errors import ConfigError, DatasetError
from dudmap.lab.benchmark import color_columns
from dudmap.lab.benchmark.color_columns import color_table, measure_recording
from dudmap.lab.benchmark.entries import Entry
from dudmap.lab.benchmark.suites import SENSORS, sensor_entries
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


def test_columns_are_measured_on_the_same_frames_and_only_the_default_calibrates(monkeypatch):
    measured = []

    def measure(sequence, config, surfaces, max_frames=None, calibrate=False):
        measured.append((id(sequence), calibrate))
        if config.tracker.color_weight == 0:
            raise DatasetError("no frame was tracked")
        return {"ate_rmse_m": config.sensor.color_time_sigma}

    monkeypatch.setattr(color_columns, "measure_sequence", measure)
    answer = measure_recording((Entry("tiny", parameters=TINY), Config()))
    assert len({sequence for sequence, _ in measured}) == 1
    assert dict(zip(answer, (calibrate for _, calibrate in measured), strict=True)) == {
        "with colour": False, "without colour": False, "default": True,
    }  # fmt: skip
    assert answer["without colour"] == {"error": "no frame was tracked"}
    assert answer["with colour"]["ate_rmse_m"] == 0
    assert answer["default"]["ate_rmse_m"] == Config().sensor.color_time_sigma


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
