"""Pixels that never count: their content changes nothing, and they are never labelled as moving."""

import cv2
import numpy as np
import pytest

from dudmap import Camera, Config, ConfigError, DatasetError, Slam
from dudmap.app.pipeline.calibration import calibrate_sequence
from dudmap.app.pipeline.run import run
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.geometry.calibration import Calibration
from dudmap.lab.synthetic import sequence
from off_course import LIMIT, off_course
from plated import Plated
from rendered import Rendered

CAMERA = Camera(fx=140.0, fy=140.0, cx=79.5, cy=59.5, width=160, height=120)
COARSE = Config().override(["volume.voxel_size=0.04"])


@pytest.fixture(scope="module")
def room():
    return Rendered(sequence("room", (), frames=25, seed=3, camera=CAMERA))


def results(recording, **given):
    slam = Slam(recording.camera, COARSE, **given)
    return slam, [slam.process(recording[index]) for index in range(len(recording))]


def test_what_an_ignored_plate_shows_changes_nothing(room):
    """The same poses, masks and mesh, bit for bit, for any texture and distance of the plate."""
    plated, other = Plated(room), Plated(room, seed=1, distance=0.7)
    region = plated.region
    slam, found = results(plated, ignore=region)
    slam_other, found_other = results(other, ignore=region)
    for result, twin in zip(found, found_other, strict=True):
        np.testing.assert_array_equal(result.T_world_camera, twin.T_world_camera)
        np.testing.assert_array_equal(result.dynamic_mask, twin.dynamic_mask)
        assert not result.dynamic_mask[region].any()
    mesh, mesh_other = slam.volume.extract_mesh(), slam_other.volume.extract_mesh()
    np.testing.assert_array_equal(mesh.vertices, mesh_other.vertices)
    np.testing.assert_array_equal(mesh.colors, mesh_other.colors)
    assert off_course(room.ground_truth.Ts_world_camera, [result.T_world_camera for result in found]) < LIMIT
    cameras = np.array([result.T_world_camera[:3, 3] for result in found])
    nearest = np.linalg.norm(mesh.vertices[:, None] - cameras[::5], axis=2).min()
    assert nearest > 0.5  # metres; the plate is nearer
    _, counted = results(plated)  # without a mask the plate moves
    assert np.mean([result.dynamic_mask[region].mean() for result in counted[1:]]) > 0.9


def test_the_region_of_the_other_camera_is_where_it_shows_the_masked_pixels_at_any_distance():
    """A point in the masked part of one image, at any distance, lies in the ignored region of the other one."""
    color = Camera(fx=300.0, fy=300.0, cx=159.5, cy=119.5, width=320, height=240)
    T_color_depth = np.eye(4)
    T_color_depth[0, 3] = 0.03
    calibration = Calibration(color, T_color_depth)
    frame = Frame(0.0, np.full(CAMERA.shape, 2.0, np.float32), np.full((*color.shape, 3), 100, np.uint8))
    for shape in (CAMERA.shape, color.shape):
        h, w = shape
        mask = np.zeros(shape, bool)
        mask[h // 2 : -h // 6, w // 3 : w // 2] = True
        prepared = Preprocessor(CAMERA, None, calibration, mask)
        for distance in (0.15, 0.5, 3.0):
            points = CAMERA.backproject(np.full(CAMERA.shape, distance, np.float32)) + T_color_depth[:3, 3]
            pixels = points[..., :2] / points[..., 2:] @ color.K[:2, :2] + color.K[:2, 2]
            u, v = np.moveaxis(np.rint(pixels).astype(int), -1, 0)
            within = (u >= 0) & (v >= 0) & (u < color.width) & (v < color.height)
            region = prepared._ignored
            if shape == CAMERA.shape:
                chosen = within & mask
                assert region.color[v[chosen], u[chosen]].mean() > 0.98
            else:
                chosen = within.copy()
                chosen[within] = mask[v[within], u[within]]
                assert region.depth[chosen].mean() > 0.9  # between two of the distances a rim is left
        observed = prepared(frame)
        assert not observed.depth[prepared._ignored.depth].any()
        assert observed.depth.any()


def test_masks_that_do_not_fit_are_refused_in_a_sentence(room, tmp_path):
    with pytest.raises(ConfigError, match=r"shape \(10, 10\).*expected \(120, 160\) bool"):
        Slam(CAMERA, ignore=np.zeros((10, 10), bool))
    with pytest.raises(ConfigError, match="covers the whole image"):
        Slam(CAMERA, ignore=np.ones(CAMERA.shape, bool))
    wrong = tmp_path / "wrong.png"
    cv2.imwrite(str(wrong), np.zeros((10, 10), np.uint8))
    with pytest.raises(DatasetError, match=r"wrong\.png is 10x10 pixels; expected 160x120"):
        run(room, COARSE, tmp_path / "run", ignore=wrong, progress=False)
    with pytest.raises(DatasetError, match=r"there is no file .*none\.png"):
        run(room, COARSE, tmp_path / "run", ignore=tmp_path / "none.png", progress=False)


def test_a_run_keeps_its_mask_and_uses_it_in_both_passes(room, tmp_path):
    plated = Plated(room)
    mask = tmp_path / "arm.png"
    cv2.imwrite(str(mask), 255 * plated.region.astype(np.uint8))
    report = run(plated, COARSE, tmp_path / "run", ignore=mask, passes=2, save_masks=True, max_frames=8, progress=False)
    assert report.metrics["lost_frames"] == []
    kept = cv2.imread(str(tmp_path / "run" / "ignored.png"), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(kept > 127, plated.region)
    for path in (tmp_path / "run" / "masks").iterdir():
        assert not cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)[plated.region].any()


def test_the_calibration_does_not_see_ignored_pixels(room):
    """Two recordings that differ in the plate alone give the same calibration."""
    mask, given = Plated(room).region, Calibration.registered(CAMERA)
    first, second = (
        calibrate_sequence(Plated(room, seed, distance), COARSE, given, ignore=mask)
        for seed, distance in ((0, 0.35), (1, 0.7))
    )
    np.testing.assert_array_equal(first.calibration.sigma, second.calibration.sigma)
    assert first.calibration.estimated == second.calibration.estimated
    assert first.pairs == second.pairs
