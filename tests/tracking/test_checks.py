"""The table of checks: every check fails beyond its limit alone, and what overrules those against the frames before."""

import csv
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from dudmap import Config, Slam
from dudmap.app.pipeline.metrics import RunRecord
from dudmap.core.geometry.camera import Camera
from dudmap.core.tracking.checks import CHECKS, MAX_IMAGE_SHIFT, RELATIVE, RULES, Limits, judged
from dudmap.core.tracking.frame_view import PoseEstimate
from dudmap.core.tracking.quality_monitor import MIN_HISTORY, ImageComparison
from dudmap.lab import synthetic

CONFIG = Config()
LIMITS = Limits(CONFIG.tracker, CONFIG.sensor, RULES, True, True, 4.0, 0.05, 0.9)
GOOD = {
    "readings": 5000.0, "overlap": 0.9, "residual_mm": 2.0, "condition": 0.1, "color_residual": 0.02,
    "speed_m_s": 0.3, "turn_deg_s": 20.0, "step": np.nan, "drift_mm": 0.0, "dynamic_share": 0.3,
    "verified_share": 0.6, "image_shift_px": 0.4, "confirmed_share": 0.9,
}  # fmt: skip


@pytest.mark.parametrize("number", range(len(CHECKS)))
def test_each_check_fails_just_beyond_its_limit_and_names_its_figure(number):
    check = CHECKS[number]
    limit = check.limit(LIMITS)
    inside, outside = (limit * (1 + side * (-1 if check.at_least else 1)) for side in (-1e-6, 1e-6))
    if limit == 0:
        pytest.skip("no limit in this situation")
    assert judged([check], GOOD | {check.figure: inside}, LIMITS).accepted
    sentence = judged([check], GOOD | {check.figure: outside}, LIMITS).reason
    assert sentence
    assert "{" not in sentence
    assert judged([check], GOOD | {check.figure: np.nan}, LIMITS).accepted  # what is not known does not reject
    assert judged(CHECKS, GOOD, LIMITS).accepted


def test_before_there_is_a_history_nothing_is_compared_with_it():
    bad = GOOD | {"residual_mm": 9.0, "overlap": 0.2, "color_residual": 0.5}
    assert judged(RELATIVE, bad, Limits(CONFIG.tracker, CONFIG.sensor)).accepted
    assert not judged(RELATIVE, bad, LIMITS).accepted


def test_a_residual_within_the_noise_of_the_sensor_is_never_unusual():
    still = replace(LIMITS, residual_mm=0.1)  # what a camera at rest leaves after averaging
    sigma_mm = 1000 * CONFIG.sensor.sigma(1.0)
    assert judged(RELATIVE, GOOD | {"residual_mm": 0.99 * sigma_mm}, still).accepted
    assert not judged(RELATIVE, GOOD | {"residual_mm": 1.01 * sigma_mm}, still).accepted


@pytest.fixture(scope="module")
def tracked():
    """A system that has tracked a few frames, the next frame and its right estimate."""
    camera = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
    room = synthetic.sequence("room", movers=(), frames=10, camera=camera, noise="kinect", seed=2)
    slam = Slam(camera, Config().override(["volume.voxel_size=0.02", "sensor.self_calibration=false"]))
    results = [slam.process(room[index]) for index in range(8)]
    assert len(results) > MIN_HISTORY
    view = slam.prepare(room[8])
    estimate = slam.front_end.register(slam.volume, view, slam.predictor.predict(slam.volume, view))
    return slam, results, view, estimate


def test_the_figures_of_every_check_are_reported_for_every_registered_frame(tracked):
    _, results, _, _ = tracked
    for result in results[1:]:
        figures = {one.name: one.figure for one in result.verdict.outcomes}
        assert set(figures) >= {check.name or check.figure for check in CHECKS}
        assert all(np.isfinite(figures[name]) for name in GOOD if name != "step")


FUSION = "color_repeats", "blind", "unobservable", "saturated", "localize", "redundant"
"""Checks that only keep a tracked frame out of the map."""


def recomputed(row):
    """Names of the checks of a row of checks.csv that reject its frame, from figures, limits and overruled checks."""
    overruled = {text.partition(": ")[0] for text in row["overruled"].split("; ")}
    failed = []
    for name, bound in (column.rsplit("_", 1) for column in row if column.endswith(("_min", "_max"))):
        figure, limit = row[name], row[f"{name}_{bound}"]
        if figure and limit and name not in overruled:
            beyond = float(figure) < float(limit) if bound == "min" else float(figure) > float(limit)
            failed += [name] * beyond
    return failed


def test_each_decision_can_be_recomputed_from_the_stored_table(tmp_path):
    camera = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
    room = synthetic.sequence("room", movers=(), frames=60, camera=camera, noise="kinect", seed=2)
    keys = ["volume.voxel_size=0.02", "sensor.self_calibration=false", "relocalization.enabled=false"]
    slam, record = Slam(camera, Config().override(keys)), RunRecord()
    for index in (*range(9), 59, 9, 10):  # the camera is elsewhere for one frame
        record.add(slam.process(replace(room[index], timestamp=room[len(record.rows)].timestamp)), 0.0, 0.0, None)
    record.save_checks(tmp_path / "checks.csv")
    rows = list(csv.DictReader((tmp_path / "checks.csv").read_text().splitlines()))
    states = [row["state"] for row in rows]
    assert "lost" in states
    assert states[-1] == "tracked"
    for row in rows:
        failed = recomputed(row)
        assert failed == [name for name in row["failed"].split("; ") if name]
        assert (row["state"] == "lost") == (not {*FUSION} >= {*failed})
        assert all(float(row[name]) >= 0 for name in ("sigma_t_mm", "sigma_r_deg") if row["state"] == "tracked")


@pytest.mark.parametrize(
    ("comparison", "accepted"),
    [
        (ImageComparison(0.4, 0.9, 0.95), True),
        (ImageComparison(0.4, 0.9, 0.6), False),  # the last frame shows another surface
        (ImageComparison(0.4, 0.2, 0.95), False),  # too little of it is in view
        (ImageComparison(2 * MAX_IMAGE_SHIFT, 0.9, 0.95), False),  # another image
        (ImageComparison(np.nan, 0.9, 0.95), False),  # images without information: a corridor is alike everywhere
        (ImageComparison(), False),  # nothing to compare with
    ],
)
def test_only_the_last_frame_overrules_an_unusual_residual(tracked, monkeypatch, comparison, accepted):
    slam, _, view, estimate = tracked
    worse = 1.1 * max(4 * np.median(slam.monitor.history.residuals), CONFIG.sensor.sigma(1.0))
    unusual = PoseEstimate(replace(estimate.tracking, residual=worse), estimate.labels)
    monkeypatch.setattr(slam.monitor.images, "compare", lambda *_: comparison)
    verdict = slam.monitor.judge(None, view, unusual, lambda *_: None)
    reason, [unusual_one] = verdict.reason, [one for one in verdict.outcomes if one.name == "usual_residual_mm"]
    assert (reason == "") == accepted, reason
    assert unusual_one.figure > unusual_one.limit
    assert unusual_one.overruled_by == ("last frame" if accepted else "")
    if not accepted:
        assert "were to be expected" in reason
    for lost in (False, True):  # whatever happened before
        slam.monitor.recovering = lost
        assert (slam.monitor.judge(None, view, unusual, lambda *_: None).reason == "") == accepted
    slam.monitor.recovering = False


def test_where_most_of_the_view_moves_the_last_frame_overrules_nothing(tracked, monkeypatch):
    """The last frame shows the same people, who may have carried the pose along."""
    slam, _, view, estimate = tracked
    worse = 1.1 * max(4 * np.median(slam.monitor.history.residuals), CONFIG.sensor.sigma(1.0))
    monkeypatch.setattr(slam.monitor.images, "compare", lambda *_: ImageComparison(0.4, 0.9, 0.95))
    for share, accepted in ((0.3, True), (0.7, False)):
        dynamic = np.indices(view.labelled.depth.shape)[1] < share * view.labelled.camera.width
        unusual = PoseEstimate(replace(estimate.tracking, residual=worse), SimpleNamespace(dynamic=dynamic))
        assert (slam.monitor.judge(None, view, unusual, lambda *_: None).reason == "") == accepted
