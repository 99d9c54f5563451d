"""What is said of a colour camera: estimated, tested and kept, or assumed."""

from dataclasses import replace

import numpy as np

from dudmap import Config
from dudmap.app.pipeline.calibration import calibrate_start
from dudmap.core.calibration.estimator import EVIDENCE, GROUPS, NOT_PROVEN, SHUTTER, TESTED, TOO_SMALL, Estimate
from dudmap.core.calibration.findings import findings, outcome
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.calibration import NUM_PARAMETERS, Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.verdict import Outcome, Verdict

CAMERA = Camera(160, 160, 79.5, 59.5, 160, 120)


def estimate(sigma: float, evidence: float, estimated: tuple[str, ...] = ()) -> Estimate:
    found = Calibration.registered(CAMERA)
    found = replace(found, sigma=np.full(NUM_PARAMETERS, sigma), estimated=estimated, vignetting_sigma=sigma)
    share = Outcome.of("share", 0.001, 0.01, TOO_SMALL, at_least=True)
    few = Outcome("evidence", reason="fewer than 14 pairs")
    tested = few if np.isnan(evidence) else Outcome.of("evidence", evidence, EVIDENCE, NOT_PROVEN, at_least=True)
    return Estimate(found, dict.fromkeys((*TESTED, SHUTTER), Verdict((tested, share))), 0.0, 80)


def test_what_was_not_tested_is_called_assumed():
    assert all("assumed as given, not tested" in finding for finding in findings(estimate(np.nan, np.nan)))


def test_what_was_tested_and_kept_has_its_uncertainty():
    shutter, timing, _, _, geometry, vignetting = findings(estimate(0.025, -0.5))
    assert "not proven (-0.5 standard errors, 3 are needed); rows are taken to be read out within 0.0 ms" in shutter
    for text in ("assumed as given; tested", "-0.5 standard errors", "delay 25 ms"):
        assert text in timing
    assert "vignetting 2.5 %" in vignetting
    for text in ("translation 25 mm", "rotation 1.4 deg", "focal length 2.5 %"):
        assert text in geometry


def test_a_significant_but_small_difference_is_not_called_none():
    assert all("too small a share to be used" in finding for finding in findings(estimate(0.025, 3.0))[1:])


def test_what_was_estimated_has_its_uncertainty():
    found = estimate(0.002, 4.0, (*GROUPS["timing"], "depth_readout"))
    shutter, timing, *_ = findings(replace(found, calibration=replace(found.calibration, depth_readout=0.027)))
    assert shutter == (
        "depth camera, shutter: estimated; other images fit 4.0 standard errors better; "
        "rows are taken to be read out within 27.0 ms"
    )
    assert timing.startswith("colour camera, timing: estimated")
    assert "delay 2 ms" in timing


def test_the_outcome_is_one_line_on_the_place_and_the_estimated_groups():
    untested, tested = estimate(np.nan, np.nan).calibration, estimate(0.002, 4.0).calibration
    assert outcome(untested, CAMERA) == "colour: registered; not tested"
    assert outcome(tested, CAMERA) == "colour: registered; no correction is proven"
    darker = replace(tested, estimated=(*GROUPS["timing"], "vignetting"), delay=0.01, vignetting=0.1)
    assert outcome(darker, CAMERA) == "colour: registered; timing, vignetting estimated"
    moved = replace(tested, camera=replace(CAMERA, fx=150.0), estimated=GROUPS["geometry"])
    assert outcome(moved, CAMERA) == "colour: a camera of its own; geometry estimated"


def test_the_findings_are_comments_of_the_file(tmp_path):
    found = estimate(0.002, 4.0)
    said = findings(found)
    replace(found.calibration, notes=tuple(said)).save(tmp_path / "calibration.toml")
    text = (tmp_path / "calibration.toml").read_text()
    assert [line[2:] for line in text.splitlines() if line.startswith("# ")][1:] == said
    assert Calibration.load(tmp_path / "calibration.toml").sigmas["delay"] == 0.002


def test_a_recording_too_short_to_be_tested_is_said_to_be_assumed(caplog):
    class Short:
        camera, calibration = CAMERA, None

        def __len__(self):
            return 5

        def __getitem__(self, index):
            return Frame(index / 30, np.full(CAMERA.shape, 2, np.float32), np.zeros((*CAMERA.shape, 3), np.uint8))

    caplog.set_level("INFO", "dudmap")
    assert calibrate_start(Short(), Config(), len(Short()), lambda done, total: None) is None
    assert caplog.messages == ["colour: assumed as given, not tested: that takes 90 frames"]
