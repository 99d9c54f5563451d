"""Algorithms 1 and 4: fusion against dense loops, and the system on a rendered room with a walking person."""

import numpy as np
import pytest

from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume
from dudmap.evaluation.trajectory import ate
from dudmap.lab import synthetic
from dudmap.thesis import ThesisConfig, ThesisSlam
from dudmap.thesis.registration import residuals
from dudmap.thesis.slam import volume_config
from oracle import fuse
from wavy_wall import CAMERA, wall

SMALL = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
FRAMES = 16
COARSE = ThesisConfig(tau=0.03, subsample="original")
"""For images of a quarter of the usual size."""


@pytest.mark.parametrize("tau", [0.025, 0.05])
def test_fusion_is_algorithm_1_with_a_band_in_metres(tau):
    config = ThesisConfig(tau=tau, d_max=0.2, d_min=0.15, w_max=3)
    volume = TsdfVolume(CAMERA, volume_config(config), depth_max=6.0)
    poses = [se3.exp(0.02 * n * np.array([1, 0.5, -1, 0.2, 0.1, 0.3])) for n in range(5)]
    frames = [wall(2.0, seed=n) for n in range(5)]
    for frame, T in zip(frames, poses, strict=True):
        volume.integrate(frame, T)
    rng = np.random.default_rng(0)
    lattice = np.rint(np.column_stack([rng.uniform(-0.4, 0.4, (400, 2)), rng.uniform(1.8, 2.2, 400)]) / tau)
    distance, weight, _ = fuse(frames, [se3.inverse(T) for T in poses], CAMERA, lattice * tau, 0.2, 0.15, 3)
    slots = volume.slots_at((lattice // 8).astype(np.int32))
    local = (lattice % 8).astype(int)
    words = volume.blocks.geometry[np.maximum(slots, 0), (local[:, 0] * 8 + local[:, 1]) * 8 + local[:, 2]]
    both = (slots >= 0) & (weight > 0)
    assert both.sum() > 200
    np.testing.assert_array_equal(((words >> 8) & 0xFF)[both], weight[both])
    near = np.abs((words >> 16)[both] * volume.sdf_unit - distance[both])
    assert np.percentile(near, 98) < 1e-4, "single voxels at pixel borders may see the pixel beside"


@pytest.fixture(scope="module")
def recording():
    return synthetic.sequence("room", frames=FRAMES, camera=SMALL, camera_path="dolly", noise="none")


@pytest.fixture(scope="module")
def run(recording):
    slam = ThesisSlam(recording.camera, COARSE)
    return slam, [slam.process(recording[n]) for n in range(FRAMES)]


def test_the_first_frame_is_static_at_the_identity(run):
    first = run[1][0]
    np.testing.assert_array_equal(first.T_world_camera, np.eye(4))
    assert first.fused
    assert not first.dynamic_mask.any()


def test_every_later_frame_takes_the_steps_of_algorithm_4(run):
    for result in run[1][1:]:
        steps = [name for name in result.timings if name != "preprocess"]
        assert steps in (["similarity"], ["similarity", "track", "label", "track_again", "integrate"])
    assert any(len(result.timings) > 2 for result in run[1])


def test_the_camera_is_followed_and_the_map_is_meshed(run, recording):
    slam, _ = run
    assert ate(slam.trajectory, recording.ground_truth).trans_errors.max() < 0.03
    assert len(slam.volume.extract_mesh().faces) > 1000
    assert slam.color_error.shape == SMALL.shape


def test_a_quarter_of_the_pixels_is_registered_coarse_to_fine():
    for subsample, width in (("quarter", 80), ("original", 160)):
        slam = ThesisSlam(SMALL, ThesisConfig(subsample=subsample, levels=2, tau=0.03))
        levels = slam._levels(slam.prepare(Frame(0.0, np.ones(SMALL.shape, np.float32))))
        assert [level.depth.shape[1] for level in levels] == [width, width // 2]


def test_seen_free_space_has_the_initial_distance_and_unseen_space_has_none():
    """Algorithm 1 initialises voxels to D_max; only space that was seen empty for long enough counts."""
    config = ThesisConfig(tau=0.02, d_max=0.2, empty_after=3)
    volume = TsdfVolume(CAMERA, volume_config(config), depth_max=6.0)
    level = Level(CAMERA, np.full(CAMERA.shape, 1.5, np.float32), np.zeros(CAMERA.shape, np.float32))
    found = []
    for _ in range(7):
        volume.integrate(wall(3.0, bump=0.0), np.eye(4))
        found.append(residuals(volume, level, np.eye(4), config.d_max).psi[20:28, 28:36])
    assert np.isnan(found[1]).all(), "not empty for long enough"
    assert (found[6] == np.float32(0.2)).all()
    behind = Level(CAMERA, np.full(CAMERA.shape, 5.0, np.float32), level.intensity)
    assert np.isnan(residuals(volume, behind, np.eye(4), config.d_max).psi).all()


def test_a_redundant_frame_keeps_the_pose_of_its_predecessor_and_is_not_fused(recording):
    slam = ThesisSlam(recording.camera, COARSE)
    results = [slam.process(recording[n]) for n in (0, 1)]
    again = slam.process(Frame(9.0, recording[1].depth, recording[1].color))
    assert "redundant" in again.verdict
    assert not again.fused
    np.testing.assert_array_equal(again.T_world_camera, results[-1].T_world_camera)
    assert "track" not in again.timings
