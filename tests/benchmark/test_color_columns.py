import pytest

from dudmap.config import Config
from dudmap.errors import ConfigError, DatasetError
from dudmap.lab.benchmark import color_columns
from dudmap.lab.benchmark.color_columns import Measurement, color_table, is_within
from dudmap.lab.benchmark.entries import Entry
from dudmap.lab.benchmark.suites import SENSORS, sensor_entries
from dudmap.lab.benchmark.table import Column
from dudmap.lab.synthetic.cameras import CAMERAS

TINY = {"scene": "box", "movers": (), "frames": 2, "camera": (64, 48), "noise": "none"}


def rows(name, with_color, without, default):
    values = {"with colour": with_color, "without colour": without, "default": default}
    return [{"sequence": name, "system": system, "ate_rmse_m": value, "lost": 0} for system, value in values.items()]


def test_default_must_be_within_five_percent_of_the_better_column():
    for default, within in ((0.0104, True), (0.0106, False), (0.008, True)):
        found = rows("a", 0.02, 0.01, default)
        assert is_within(found[2], found[:2]) is within
    assert is_within({"error": "lost"}, rows("a", 1, 1, 1)[:2]) is None


def test_table_has_a_line_per_recording():
    other = [row | {"drift_rmse_m": 0.004, "lost": 3} for row in rows("b", None, None, None)]
    text = color_table([*rows("a", 0.02, 0.01, 0.0108), *other], {"b": Column("drift_rmse_m", "drift, mm", 1000, 1)})
    lines = text.splitlines()
    assert lines[2] == "| a | ATE RMSE, mm | 20.0 | 10.0 | 10.8 | 10.0 | 1.08 | NO |"
    assert lines[3] == "| b | drift, mm | 4.0 (3 lost) | 4.0 (3 lost) | 4.0 (3 lost) | 4.0 | 1.00 | yes |"


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
    configs = {name: Config().override(settings) for name, settings in color_columns.SETTINGS.items()}
    answer = color_columns._measure(Measurement(Entry("tiny", parameters=TINY), configs))["rows"]
    assert len({sequence for sequence, _ in measured}) == 1
    assert dict(zip(configs, (calibrate for _, calibrate in measured), strict=True)) == {
        "with colour": False, "without colour": False, "default": True,
    }  # fmt: skip
    assert answer[list(configs).index("without colour")] == {"error": "no frame was tracked"}
    assert answer[list(configs).index("with colour")]["ate_rmse_m"] == 0
    assert answer[list(configs).index("default")]["ate_rmse_m"] == Config().sensor.color_time_sigma


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
