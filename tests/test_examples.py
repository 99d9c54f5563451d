"""The examples run as they stand."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from dudmap import Config
from dudmap.core.frames.observation import Level
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.tracking.tracker import Tracker
from wavy_wall import CAMERA, wall

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.mark.parametrize("name", sorted(path.name for path in EXAMPLES.glob("*.py")))
def test_example(name, tmp_path, monkeypatch, capsys):
    target = tmp_path / "fused.ply" if name == "fuse_known_poses.py" else tmp_path
    monkeypatch.setattr(sys, "argv", [name, str(target)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    assert capsys.readouterr().out


def test_the_loop_by_hand_gives_the_poses_of_the_system(capsys):
    runpy.run_path(str(EXAMPLES / "own_loop.py"))
    assert capsys.readouterr().out.splitlines() == ["difference from Slam: 0.0 m, 0.0 deg"] * 8


def test_outliers_do_not_draw_a_registration_with_tukeys_weight(capsys):
    """A fifth of a wall stands 3 cm nearer than in the map."""
    tukey, errors = runpy.run_path(str(EXAMPLES / "own_cost.py"))["TukeyTracker"], []
    config = Config().override(
        ["tracker.huber=1", "tracker.widths=[64]", "tracker.iterations=[8]", "tracker.color_weight=0"]
    )
    volume = TsdfVolume(CAMERA, config.volume, config.sensor)
    frame = wall(1.0, seed=0)
    for _ in range(3):
        volume.integrate(frame, np.eye(4))
    depth = frame.depth.copy()
    depth[:, :12] -= 0.03
    level = Level(CAMERA, depth, np.zeros(CAMERA.shape, np.float32))
    for kind in (Tracker, tukey):
        found = kind(config.tracker, config.sensor).align(volume, [level], np.eye(4))
        errors.append(np.linalg.norm(found.T_world_camera - np.eye(4)))
    assert errors[1] < 0.1 * errors[0]
