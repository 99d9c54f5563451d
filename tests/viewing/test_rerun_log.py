"""The log for Rerun, read back by Rerun's own program."""

import subprocess
import sys

import pytest

from dudmap.errors import DudmapError
from growing_map import GrowingMap, read

pytest.importorskip("rerun", reason="the extra rerun is not installed")


def test_the_log_holds_camera_images_map_and_plots(tmp_path):
    from dudmap.app.viewing.rerun_log import RerunLog

    log, slam = RerunLog(tmp_path / "run.rrd"), GrowingMap()
    log.start(slam, tmp_path, 5)
    for k in range(5):
        log.frame(k, read(k), slam.step(k), 12.0)
    log.finish(tmp_path)
    done = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "stats", str(tmp_path / "run.rrd")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    expected = (
        "/world/camera:", "/world/camera/color:", "/world/camera/depth:", "/world/map/", "/world/trajectory:",
        "/world/movers:", "/images/mask:", "/images/residuals:", "/plots/ms:", "/plots/moving_percent:",
    )  # fmt: skip
    for entity in expected:
        assert entity in done.stdout


@pytest.mark.parametrize(("name", "sentence"), [("run.log", "ends in .rrd"), ("no/run.rrd", "cannot write the log")])
def test_files_that_cannot_be_written(tmp_path, name, sentence):
    from dudmap.app.viewing.rerun_log import RerunLog

    with pytest.raises(DudmapError, match=sentence):
        RerunLog(tmp_path / name)
