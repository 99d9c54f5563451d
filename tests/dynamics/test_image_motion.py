"""Motion from image to image against the truth of synthetic worlds and against numerical derivatives."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from dudmap.config import Config, TrackerConfig
from dudmap.core.backends.cpu import labeling
from dudmap.core.dynamics import dominant_motion as dominant
from dudmap.core.dynamics import image_motion
from dudmap.core.dynamics.dominant_motion import dominant_motion
from dudmap.core.frames.optical_flow import consistent_with_static
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.mapper import Mapper
from dudmap.core.slam import Slam
from dudmap.core.tracking.checks import RELATIVE, judged
from dudmap.core.tracking.frame_view import PoseEstimate
from dudmap.core.tracking.motion_model import MotionModel
from dudmap.core.tracking.quality_monitor import QualityMonitor
from dudmap.core.tracking.tracker import TrackingResult
from dudmap.core.verdict import ACCEPTED
from dudmap.evaluation.trajectory import ate
from dudmap.lab import synthetic
from rendered import Rendered

CAMERA = Camera(262.5, 262.5, 159.5, 119.5, 320, 240)


@pytest.fixture(scope="module")
def crowd():
    """People who hide about half of the image from the first frame on."""
    return Rendered(
        synthetic.sequence("room", coverage=0.5, start_dynamic=True, frames=22, camera=CAMERA, noise="kinect")
    )


@pytest.fixture(scope="module")
def followed(crowd):
    """The system after the recording of the crowd, and its results."""
    slam = Slam(crowd.camera)
    return slam, [slam.process(crowd[index]) for index in range(len(crowd))]


def image(sequence, index, **changed):
    """Pyramid of a frame, whose finest level has something changed, and its segments."""
    prepared = Slam(sequence.camera).prepare(sequence[index])
    *coarser, fine = prepared.pyramid.tracked
    return replace(prepared.pyramid, tracked=[*coarser, replace(fine, **changed)]), prepared.segmentation()


def compare(before, after, moved=None):
    return dominant_motion(before[0], after[0], (before[1], after[1]), moved)


@pytest.mark.parametrize("index", [0, 6, 20])
def test_a_crowd_over_half_of_the_image_is_not_the_world(crowd, index):
    before = image(crowd, index)
    small = before[0].labelled
    motion = compare(before, image(crowd, index + 1))
    truth = crowd.ground_truth.Ts_world_camera
    off = motion.T_after_before @ se3.inverse(truth[index]) @ truth[index + 1]
    assert np.linalg.norm(off[:3, 3]) < 0.006
    assert np.degrees(se3.rotation_angle(off)) < 0.15
    mask = crowd.mask(index)[1::2, 1::2] & (small.depth > 0)
    assert mask.mean() > 0.3
    assert np.count_nonzero(motion.moving_before & mask) > 0.85 * np.count_nonzero(mask)
    assert np.count_nonzero(motion.moving_before & ~mask) < 0.05 * mask.size


@pytest.mark.parametrize("width", [160, 640])
def test_motion_and_labels_agree_at_any_resolution(width):
    full = synthetic.sequence("room", coverage=0.5, start_dynamic=True, frames=8, noise="kinect", seed=2)
    slam = Slam(full.camera, Config().override([f"tracker.widths=[{width // 4}, {width // 2}, {width}]"]))
    before, after = (slam.prepare(full[index]) for index in (6, 7))
    assert before.pyramid.fine.camera.width == width
    motion = dominant_motion(before.pyramid, after.pyramid, (before.segmentation(), after.segmentation()))
    truth = full.ground_truth.Ts_world_camera
    off = motion.T_after_before @ se3.inverse(truth[6]) @ truth[7]
    assert np.linalg.norm(off[:3, 3]) < 0.006
    mask = full.mask(7)[2::4, 2::4] & (after.pyramid.labelled.depth > 0)
    assert mask.mean() > 0.3
    found = motion.moving_after
    assert np.count_nonzero(found & mask) > 0.75 * np.count_nonzero(found | mask)


def test_nothing_moves_in_a_still_room():
    room = synthetic.sequence("room", movers=(), frames=8, camera=CAMERA, noise="kinect")
    motion = compare(image(room, 4), image(room, 5))
    assert motion.share > 0.9
    assert motion.moving_after.mean() < 0.01


def test_a_shaken_image_makes_nothing_move(monkeypatch):
    """Lines of an image that are exposed one after the other bend what stands still (rolling shutter)."""
    room = synthetic.sequence("room", movers=(), frames=8, camera=CAMERA, noise="kinect")
    before, after = image(room, 4), image(room, 5)[0].fine
    v, u = np.indices(after.depth.shape, dtype=np.float32)
    bend = (1.0 * np.sin(v / 25)).astype(np.float32)
    bent = cv2.remap(after.intensity, u + bend, v, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
    shaken = image(room, 5, intensity=bent)
    assert compare(before, shaken).moving_after.mean() < dominant.NOISE_SHARE
    monkeypatch.setattr(dominant, "MOVES_SIGMAS", 0.5)  # without regard to how well the other corners fit
    assert compare(before, shaken).moving_after.mean() > 0.03


def test_a_corner_that_could_as_well_rest_is_told_from_one_that_moved():
    rng = np.random.default_rng(1)
    first = cv2.GaussianBlur(rng.uniform(0, 255, (120, 160)), (0, 0), 1.5)
    first = cv2.normalize(first, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    second = first.copy()
    second[30:90, 88:140] = first[30:90, 80:132]  # the right half of the middle moved by eight pixels
    pixels = np.array([[30, 60], [60, 40], [110, 60], [100, 50]])
    rests = consistent_with_static(first, second, pixels, pixels.astype(float), np.full(4, 1.0), np.full(4, 0.5))
    assert rests.tolist() == [True, True, False, False]


def test_images_without_corners_tell_nothing(crowd):
    blank = image(crowd, 0, intensity=np.full((240, 320), 0.5, np.float32))
    assert compare(blank, blank) is None


def test_a_pair_of_images_is_compared_once_and_never_with_a_forgotten_one(crowd):
    known, before, after = image_motion.ImageMotion(1.0), image(crowd, 6), image(crowd, 7)
    known.start(0.0)
    before = image_motion.TrackedImage(0.0, np.eye(4), *before)
    after, later = (image_motion.TrackedImage(time, np.eye(4), *after) for time in (0.1, 0.2))
    assert known.compare(before) is None
    known.update(before)
    motion = known.compare(after)
    assert motion is not None
    assert known.compare(after) is motion
    assert known.compare(later) is not motion
    known.reset()
    assert known.compare(after) is None
    assert not known.active


def test_where_everything_is_known_to_move_nothing_tells_the_world(crowd):
    before, after = image(crowd, 6), image(crowd, 7)
    assert compare(before, after, np.ones(before[0].labelled.depth.shape, bool)) is None


def test_what_is_known_to_move_has_no_majority(crowd):
    """Of a view that people fill but for its edges the rest still tells the camera's motion."""
    moved, depth = crowd.mask(6)[1::2, 1::2], image(crowd, 6)[0].fine.depth
    far = image(crowd, 6, depth=np.where(crowd.mask(6), depth * 4, depth))  # they outweigh the room
    motion = compare(far, image(crowd, 7), moved)
    truth = crowd.ground_truth.Ts_world_camera
    off = motion.T_after_before @ se3.inverse(truth[6]) @ truth[7]
    assert np.linalg.norm(off[:3, 3]) < 0.006


def test_people_who_fill_the_view_do_not_take_a_camera_at_rest_along():
    people = synthetic.sequence("room", coverage=0.7, camera_path="still", frames=90, camera=CAMERA, noise="kinect")
    slam = Slam(people.camera)
    results = [slam.process(people[index]) for index in range(56)]
    assert np.mean([people.mask(index).mean() for index in range(40, 56)]) > 0.7
    assert all(result.status == "tracked" for result in results)
    assert max(np.linalg.norm(result.T_world_camera[:3, 3]) for result in results) < 0.025


def test_a_view_that_hardly_shows_the_known_world_is_not_decided(crowd):
    slam = Slam(crowd.camera)
    results = [slam.process(crowd[index]) for index in range(3)]
    labels, tracked = results[2]._labels, results[2]._tracking
    view = slam.prepare(crowd[2])
    rows = np.arange(labels.dynamic.shape[0])[:, None] >= 0.2 * labels.dynamic.shape[0]
    hidden = replace(labels, dynamic=np.broadcast_to(rows, labels.dynamic.shape))
    monitor = QualityMonitor(slam.config, slam.motion)
    well_known, unknown = (PoseEstimate(replace(tracked, inlier_share=share), hidden) for share in (0.9, 0.2))
    assert monitor.judge(None, view, well_known, lambda *_: None).reason == ""
    assert "are static on the map" in monitor.judge(None, view, unknown, lambda *_: None).reason


def test_a_crowd_from_the_first_frame_does_not_drag_the_camera_along(crowd, followed):
    assert Config().dynamics.start_seconds == 1.0
    truth = crowd.ground_truth.Ts_world_camera
    blind, largest = Slam(crowd.camera, Config().override(["dynamics.start_seconds=0"])), {}
    for seconds, results in ((1.0, followed[1]), (0.0, [blind.process(crowd[n]) for n in range(len(crowd))])):
        off = [
            (se3.inverse(truth[0]) @ truth[index])[:3, 3] - result.T_world_camera[:3, 3]
            for index, result in enumerate(results)
            if result.T_world_camera is not None
        ]
        largest[seconds] = np.linalg.norm(off, axis=1).max()
    assert largest[1.0] < 0.02
    assert largest[0.0] > 0.1  # so that it was the comparison of images that helped


def test_a_crowd_that_hides_most_of_the_first_frames_has_no_say():
    sequence = synthetic.sequence("room", coverage=0.7, speed=1.0, start_dynamic=True, frames=20, camera=CAMERA, seed=0)
    slam = Slam(CAMERA, Config())
    truth = se3.inverse(sequence.ground_truth.Ts_world_camera[0]) @ sequence.ground_truth.Ts_world_camera
    results = [slam.process(sequence[index]) for index in range(len(sequence))]
    off = [
        np.linalg.norm(T[:3, 3] - result.T_world_camera[:3, 3])
        for T, result in zip(truth, results, strict=True)
        if result.fused
    ]
    assert len(off) > 10
    assert max(off) < 0.08, f"{max(off):.3f} m"


def test_what_drags_the_pose_is_doubted_at_twice_the_usual_residual():
    good = TrackingResult(np.eye(4), (1.0, 0.0), ACCEPTED, 0.9, 0.002, 0.01, 3, 0.01)
    monitor = QualityMonitor(Config(), MotionModel(TrackerConfig()))
    for _ in range(6):
        monitor.accept(good)
    dragged = replace(good, residual=0.0045).figures
    assert "4.5 mm" in judged(RELATIVE, dragged, monitor.limits()).reason
    assert judged(RELATIVE, replace(good, residual=0.0035).figures, monitor.limits()).accepted


def test_a_box_that_creeps_from_the_first_frame_on_does_not_drag_the_camera_along():
    sequence = synthetic.sequence(
        "room", movers=("creeper",), start_dynamic=True, camera_path="orbit", frames=32, camera=CAMERA, seed=13
    )
    slam = Slam(CAMERA, Config())
    results = [slam.process(sequence[index]) for index in range(len(sequence))]
    truth = se3.inverse(sequence.ground_truth.Ts_world_camera[0]) @ sequence.ground_truth.Ts_world_camera
    off = np.linalg.norm(truth[-1, :3, 3] - results[-1].T_world_camera[:3, 3])
    assert off < 0.015, f"{off:.3f} m"
    mask = sequence.mask(31)
    assert results[-1].dynamic_mask[mask].mean() > 0.5


def test_a_second_pass_of_a_short_recording_knows_who_stood_in_its_first_frame(crowd, followed):
    once = [result.dynamic_mask for result in followed[1]]
    second = Slam(crowd.camera, first_pass=followed[0])
    twice = [second.process(crowd[index]).dynamic_mask for index in range(len(crowd))]

    def overlaps(found):
        masks = [crowd.mask(index) for index in range(len(crowd))]
        return np.array([(f & m).sum() / (f | m).sum() for f, m in zip(found, masks, strict=True)])

    assert overlaps(once)[0] == 0  # one frame tells nothing
    assert overlaps(once)[1:].mean() > 0.85  # the target for people
    assert overlaps(twice).min() > 0.85
    assert overlaps(twice).mean() > overlaps(once)[1:].mean()


@pytest.mark.slow
def test_a_second_pass_knows_what_the_first_frames_could_not():
    people = synthetic.sequence("room", coverage=0.3, start_dynamic=True, frames=60, camera=CAMERA, noise="kinect")
    frames, masks = [people[index] for index in range(40)], [people.mask(index) for index in range(40)]

    def overlap(results):
        both = sum(np.count_nonzero(r.dynamic_mask & m) for r, m in zip(results, masks, strict=False))
        return both / sum(np.count_nonzero(r.dynamic_mask | m) for r, m in zip(results, masks, strict=False))

    first = Slam(people.camera)
    once = [first.process(frame) for frame in frames]
    second = Slam(people.camera, first_pass=first)
    twice = [second.process(frame) for frame in frames]
    assert {result.status for result in twice} == {"tracked"}
    assert overlap(twice[:10]) > overlap(once[:10])
    assert overlap(twice) > 0.85  # the target for people


def test_labels_at_full_size_take_after_the_low_pixel_most_alike_in_depth_else_the_nearest():
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 4, (48, 64)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0
    low_depth = np.ascontiguousarray(depth[2::4, 2::4])
    low = rng.random(low_depth.shape) < 0.3
    low[:4] = False
    out = labeling.upsample_labels(low, low_depth, depth, 4)
    for v in range(48):
        for u in range(64):
            y, x = (2 * v - 3) // 8, (2 * u - 3) // 8  # centre of low pixel k: 4 k + 1.5
            best, label = np.inf, 0
            for i, j in ((y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1)):
                away = abs(4 * i + 1.5 - v) + abs(4 * j + 1.5 - u)
                i, j = min(max(i, 0), 11), min(max(j, 0), 15)
                a, b = low_depth[i, j], depth[v, u]
                gap = (abs(a - b) if (a > 0) == (b > 0) else 64.0) + 1e-4 * away / 4
                if gap < best - 1e-5:
                    best, label = gap, low[i, j]
            assert out[v, u] == label


# the camera followed people of 0.3 m/s for a while, and those of 0.1 m/s, over half of the image, for good
@pytest.mark.parametrize(("coverage", "speed", "seed"), [(0.42, 0.3, 0), (0.5, 0.1, 20)])
def test_a_young_map_with_a_slow_crowd_begins_anew_without_it(coverage, speed, seed, monkeypatch):
    camera = Camera(262.5, 262.5, 159.5, 119.5, 320, 240)
    sequence = synthetic.sequence(
        "room", coverage=coverage, speed=speed, start_dynamic=True, frames=16, camera=camera, seed=seed
    )
    fused = []
    integrate = Mapper.integrate
    monkeypatch.setattr(Mapper, "integrate", lambda mapper, *args: (fused.append(args), integrate(mapper, *args)))
    slam = Slam(camera)
    results = [slam.process(sequence[index]) for index in range(16)]
    assert all(result.fused for result in results)
    truth = se3.inverse(sequence.ground_truth.Ts_world_camera[0]) @ sequence.ground_truth.Ts_world_camera
    errors = [np.linalg.norm(result.T_world_camera[:3, 3] - T[:3, 3]) for result, T in zip(results, truth, strict=True)]
    assert max(errors[12:]) < 0.015, errors
    masks = {view.timestamp: mask for view, _, mask in fused}  # the last fusion of each frame
    for index in (0, 1, 5, 15):
        people = sequence.mask(index) & (sequence[index].depth > 0)
        assert masks[sequence.timestamps[index]][people].mean() > 0.85, index


def test_people_who_enter_with_a_slow_crowd_do_not_take_the_camera_along():
    """They are in no older image, and nearer measurements weigh more.

    The median of three crowds, because a focal length changed by 3e-7 takes one of them from 32 to 60 mm.
    """
    errors = []
    for seed in (31, 32, 33):
        sequence = synthetic.sequence(
            "room", coverage=0.6, speed=0.1, start_dynamic=True, frames=45, camera=CAMERA, seed=seed
        )
        slam = Slam(CAMERA)
        poses = [slam.process(sequence[index]).T_world_camera for index in range(45)]
        truth = se3.inverse(sequence.ground_truth.Ts_world_camera[0]) @ sequence.ground_truth.Ts_world_camera
        off = [np.linalg.norm(pose[:3, 3] - T[:3, 3]) for pose, T in zip(poses[-10:], truth[35:45], strict=True)]
        errors.append(np.mean(off))
    assert np.median(errors) < 0.035


UNDECIDED = pytest.mark.xfail(strict=True, reason="poses follow the crowd until the first frames are decided at 0.4 s")


@pytest.mark.parametrize(("seed", "frames"), [pytest.param(1, 12, marks=UNDECIDED), (1, 26), (4, 26)])
def test_a_slow_crowd_over_most_of_the_view_does_not_take_the_camera_along(seed, frames):
    sequence = synthetic.sequence(
        "room", coverage=0.7, speed=0.1, start_dynamic=True, frames=frames, camera=CAMERA, seed=seed
    )
    slam = Slam(CAMERA)
    T_world_camera = [slam.process(sequence[index]).T_world_camera for index in range(frames)][-1]
    truth = sequence.ground_truth.Ts_world_camera
    assert np.linalg.norm((se3.inverse(truth[0]) @ truth[-1])[:3, 3] - T_world_camera[:3, 3]) < 0.025  # was 43, 50 mm


def test_a_young_map_that_followed_a_crowd_begins_anew_and_its_poses_are_corrected():
    """Seven tenths of the view walk at 0.3 m/s; the camera follows them until older images show it."""
    sequence = synthetic.sequence("room", coverage=0.7, speed=0.3, start_dynamic=True, frames=24, camera=CAMERA)
    slam, truth = Slam(CAMERA), sequence.ground_truth
    results = [slam.process(sequence[index]) for index in range(24)]
    restarted = ["corrected" in result.events for result in results].index(True)
    followed = results[restarted - 1].T_world_camera
    wanted = (se3.inverse(truth.Ts_world_camera[0]) @ truth.Ts_world_camera[restarted - 1])[:3, 3]
    assert np.linalg.norm(followed[:3, 3] - wanted) > 0.05
    assert {result.submap for result in results} == {0}
    people = sequence.mask(restarted) & (sequence[restarted].depth > 0)
    assert results[restarted].dynamic_mask[people].mean() > 0.8
    assert len(slam.trajectory) == 24
    assert ate(slam.trajectory, truth).rmse < 0.015  # not corrected: 29 mm


def test_a_start_without_a_crowd_is_not_corrected():
    sequence = synthetic.sequence("room", movers=("person",), start_dynamic=True, frames=15, camera=CAMERA)
    slam = Slam(CAMERA)
    assert not any("corrected" in slam.process(sequence[index]).events for index in range(15))
