"""Frames are labelled where they fit the distances of the map, not where displaced colours have drawn their pose."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dudmap import Config, Slam
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.tracking.frame_view import PoseEstimate
from dudmap.core.tracking.pose_prediction import PosePrediction
from dudmap.lab import synthetic

CAMERA = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
DRAWN = np.array([0.0, 0.0, 0.03, 0.02, 0.01, 0.0])


@pytest.fixture(scope="module")
def tracked():
    sequence: Any = synthetic.sequence("desk", movers=(), frames=13, noise="kinect", seed=5, camera=CAMERA)
    slam = Slam(sequence.camera, Config().override(["dynamics.start_seconds=0"]))
    result = [slam.process(sequence[n]) for n in range(13)][-1]
    assert result._tracking is not None
    return slam, slam.prepare(sequence[12]), result._tracking


def labelled(tracked, moving=None):
    """Share of the readings that are dynamic where a registration has ended ``DRAWN`` beside the pose."""
    slam, view, tracking = tracked
    T_drawn = se3.retract(tracking.T_world_camera, DRAWN)
    prediction = PosePrediction(T_drawn, lambda: None, lambda: None, moving)
    labels = slam.front_end._label(slam.reference, view, prediction, replace(tracking, T_world_camera=T_drawn))
    return np.count_nonzero(labels.dynamic) / np.count_nonzero(view.labelled.depth)


def test_what_fits_the_map_under_a_pose_near_the_tracked_one_is_static(tracked):
    assert labelled(tracked) < 0.01


def test_while_images_are_compared_the_pose_stays(tracked):
    """A mover of the first frame is part of a young map, and the distances alone would follow it."""
    assert labelled(tracked, moving=np.zeros(tracked[1].labelled.depth.shape, bool)) > 0.05


def test_what_moves_close_to_the_camera_does_not_take_the_labelled_pose_along(tracked):
    """The nearest fifth of the readings, which weighs most, has come 12 mm nearer."""
    slam, view, tracking = tracked
    depth, T = view.labelled.depth.copy(), tracking.T_world_camera
    depth[(depth > 0) & (depth < np.percentile(depth[depth > 0], 20))] -= np.float32(0.012)
    level = replace(view.labelled, depth=depth)
    blind = slam.front_end.blind_tracker
    before = blind.linearize(slam.reference, level, T, np.ones_like(depth)).residuals[0]
    T_nearest, after = blind.nearest(slam.reference, level, T)
    assert np.linalg.norm(se3.log(T_nearest @ se3.inverse(T))[:3]) > 0.008
    assert np.nanmean(np.abs(after)) < np.nanmean(np.abs(before))
    moved = SimpleNamespace(without_image=False, known_dynamic=None, labelled=level)
    prediction = PosePrediction(T, lambda: None, lambda: None, None)
    np.testing.assert_array_equal(slam.front_end._by_distances(slam.reference, moved, prediction, tracking), T)


def test_the_nearest_minimum_of_the_distances_is_at_the_true_pose_where_a_desk_determines_it(tracked):
    slam, view, tracking = tracked
    T_drawn = se3.retract(tracking.T_world_camera, DRAWN)
    T, *_ = slam.front_end.blind_tracker.nearest(slam.reference, view.labelled, T_drawn)
    _, _, z, roll, pitch, _ = se3.log(T @ se3.inverse(tracking.T_world_camera))
    assert abs(z) < 0.004
    assert np.hypot(roll, pitch) < np.radians(0.3)


@pytest.mark.parametrize("known", [False, True])
def test_what_two_images_show_to_move_is_left_out_where_a_registration_fits_badly(tracked, monkeypatch, known):
    """Again from the same pose, unless the labels know all of it already."""
    slam, view, tracking = tracked
    moving = np.zeros(view.labelled.depth.shape, bool)
    moving[:, 40:80] = view.labelled.depth[:, 40:80] > 0
    labels = SimpleNamespace(dynamic=moving if known else np.zeros_like(moving))
    asked = []

    def register_from(volume, view, prediction, T_init):
        asked.append(prediction.moving)
        fits = prediction.moving is not None
        return PoseEstimate(replace(tracking, color_residual=0.01 if fits else 0.03), labels, None, view)

    monkeypatch.setattr(slam.front_end, "register_from", register_from)
    monkeypatch.setattr(slam.monitor, "is_unusual", lambda found: found.color_residual > 0.02)
    monkeypatch.setattr(slam.monitor, "relative_misfit", lambda found: (1.0, 100 * found.color_residual))
    T, motion = tracking.T_world_camera, SimpleNamespace(moving_after=moving)
    found = slam.front_end.register(slam.reference, view, PosePrediction(T, lambda: T, lambda: motion))
    assert [left_out is not None for left_out in asked] == ([False] if known else [False, True])
    assert found.tracking.color_residual == (0.03 if known else 0.01)
