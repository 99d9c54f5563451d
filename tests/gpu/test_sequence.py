"""A whole recording on the device: the result of the CPU, and the same in every run."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dudmap.config import Config
from dudmap.core.slam import Slam
from dudmap.lab.synthetic import sequence
from small_maps import CAMERA

pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")

FRAMES = 12
VOXEL = 0.02


def processed(frames, device):
    slam = Slam(CAMERA.resized(320, 240), Config().override([f"device={device}", f"volume.voxel_size={VOXEL}"]))
    results = [slam.process(frame) for frame in frames]
    poses = np.array([result.T_world_camera for result in results])
    masks = np.array([result.dynamic_mask for result in results])
    return poses, masks, slam.volume.extract_mesh()


@pytest.fixture(scope="module")
def runs():
    recording = sequence(frames=FRAMES, camera=CAMERA.resized(320, 240), noise="none", start_dynamic=True)
    frames = [recording[index] for index in range(FRAMES)]
    return [processed(frames, device) for device in ("cpu", "warp-cpu", "warp-cpu")]


def test_the_device_gives_the_trajectory_masks_and_mesh_of_the_cpu(runs):
    """Rounding can end a registration one iteration earlier, up to its tolerance (1 mm on the coarser levels) apart;
    three of those bound every frame, and half of one the median."""
    (poses, masks, mesh), (other_poses, other_masks, other_mesh), _ = runs
    apart = np.linalg.norm(poses[:, :3, 3] - other_poses[:, :3, 3], axis=1)
    assert np.median(apart) < 0.5e-3
    assert apart.max() < 3e-3
    turn = np.einsum("nji,njk->nik", poses[:, :3, :3], other_poses[:, :3, :3])
    angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert np.degrees(np.median(angle)) < 0.02
    assert np.degrees(angle.max()) < 0.12
    assert masks.any()
    assert (masks & other_masks).sum() / (masks | other_masks).sum() > 0.995
    distance = cKDTree(mesh.vertices).query(other_mesh.vertices)[0]
    assert (distance < VOXEL / 4).mean() > 0.99


def test_two_runs_on_the_device_are_equal_to_the_bit(runs):
    _, one, two = runs
    for a, b in zip(one[:2], two[:2], strict=True):
        assert np.array_equal(a, b)
    for name in ("vertices", "faces", "colors", "normals"):
        assert np.array_equal(getattr(one[2], name), getattr(two[2], name))
