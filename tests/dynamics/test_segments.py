"""Surface segmentation, what has settled, and the labels of slow, starting and stopping objects."""

import numpy as np
import pytest

from dudmap.config import DynamicsConfig, SensorConfig, VolumeConfig
from dudmap.core.backends.cpu.segment_motion import classify_segments, counts_in, split_mixed_segments
from dudmap.core.dynamics.detector import DynamicDetector
from dudmap.core.dynamics.segments import intensity_gradient, segment
from dudmap.core.dynamics.temporal_memory import TemporalMemory
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Level, Pyramid
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.slam import Slam
from dudmap.lab import synthetic

CAMERA = Camera(131, 131, 79.5, 59.5, 160, 120)
SMALL = Camera(262.5, 262.5, 159.5, 119.5, 320, 240)
RAYS = CAMERA.backproject(np.ones(CAMERA.shape, np.float32))
TOLERANCE = np.full(CAMERA.shape, 0.08, np.float32)


def plane(normal, point):
    """Depth (h, w) of a plane."""
    normal = np.asarray(normal, float)
    return ((normal @ point) / (RAYS @ normal)).astype(np.float32)


def level(depth, intensity=None):
    grey = np.full(CAMERA.shape, 0.5, np.float32) if intensity is None else intensity.astype(np.float32)
    return Level(CAMERA, depth.astype(np.float32), grey)


def large(surface):
    return [n for n in range(1, surface.count + 1) if np.count_nonzero(surface.labels == n) > 200]


def test_a_concave_edge_cuts_and_a_convex_one_does_not():
    left, right = plane([-1, 0, 1], [0, 0, 2]), plane([1, 0, 1], [0, 0, 2])
    assert len(large(segment(level(np.maximum(left, right)), TOLERANCE))) == 1  # the ridge faces the camera
    concave = segment(level(np.minimum(left, right)), TOLERANCE)
    # every reading belongs to a segment, and the boundary lies in the concave edge
    assert len(large(concave)) == 2
    assert (concave.labels > 0).mean() > 0.99
    assert np.all(concave.labels[:, :70] == concave.labels[60, 20])
    assert np.all(concave.labels[:, 90:] == concave.labels[60, 140])


def test_a_step_smaller_than_the_slope_of_the_floor_cuts():
    """Two boards 5 cm apart are two segments, although a slanted floor has larger steps between its pixels."""
    depth = np.full(CAMERA.shape, 2.0)
    depth[:, 80:] = 2.05
    boards = segment(level(depth), TOLERANCE).labels
    assert np.all(boards[:, :75] == boards[60, 20])
    assert np.all(boards[:, 85:] == boards[60, 140])
    assert boards[60, 20] != boards[60, 140]
    floor = plane([0, 1, 0.1], [0, 0.6, 0])
    floor[(floor <= 0) | (floor > 4)] = 0
    assert np.abs(np.diff(floor[70:], axis=0)).max() > 0.05
    assert len(large(segment(level(floor), TOLERANCE))) == 1


def split(segmentation, before):
    labels, count = segmentation.labels, segmentation.count
    total, part, _ = counts_in(labels, count, before, before)
    return split_mixed_segments(labels, count, before, total, part, segmentation.min_pixels)


def test_segments_that_have_merged_are_split_by_their_last_labels():
    whole = segment(level(np.full(CAMERA.shape, 2.0)), TOLERANCE)
    body = np.zeros(CAMERA.shape, bool)
    assert split(whole, body)[1] == whole.count
    body[:, :60] = True
    labels, count = split(whole, body)
    assert count == whole.count + 1
    assert len(np.unique(labels[body])) == len(np.unique(labels[~body])) == 1
    body[:, 6:60] = False  # a strip that came into view
    labels, count = split(whole, body)
    assert count == whole.count
    assert np.array_equal(labels, whole.labels)


def scene(x):
    """A textured board at (x, 0, 2) before a textured wall at 3 m, and its pixels."""
    v, u = np.indices(CAMERA.shape)
    X, Y = (u - CAMERA.cx) / CAMERA.fx * 2 - x, (v - CAMERA.cy) / CAMERA.fy * 2
    board = (np.abs(X) < 0.4) & (np.abs(Y) < 0.4)
    own = 0.5 + 0.2 * np.sin(30 * X) * np.cos(30 * Y)
    wall = 0.5 + 0.2 * np.sin(u / 5.0) * np.cos(v / 5.0)
    return level(np.where(board, 2.0, 3.0), np.where(board, own, wall)), board


@pytest.mark.parametrize(("speed", "stands"), [(0.0, True), (0.05, False)])
def test_a_segment_that_stood_still_for_the_settle_time_has_settled(speed, stands):
    memory = TemporalMemory(DynamicsConfig(settle_time=1.0))
    sigma = np.full(CAMERA.shape, 0.01, np.float32)
    for i in range(35):
        image, board = scene(speed * i / 30)
        surface = segment(image, TOLERANCE)
        still = memory.settled(i / 30, image, np.eye(4), surface, sigma, board)
        assert not still[~board].any()
        if i < 30:
            assert not still.any()
        memory.update(i / 30, image, np.eye(4), board, surface)
        before = memory.last_dynamic(image, np.eye(4))
        inner = board.copy()
        inner[1:, 1:] &= board[:-1, :-1]
        assert before[inner].mean() > 0.9
        assert not before[~board].any()
    assert (still[board].mean() > 0.9) == stands
    memory.reset()
    assert not memory.settled(i / 30, image, np.eye(4), surface, sigma, board).any()


def test_what_is_remembered_follows_a_correction_of_the_world():
    """As if the world had been the corrected one from the first frame on."""
    correction, sigma = se3.exp(np.array([0.3, -0.1, 0.2, 0.0, 0.1, 0.05])), np.full(CAMERA.shape, 0.01, np.float32)
    memory, (image, board) = TemporalMemory(DynamicsConfig(settle_time=1.0)), scene(0.0)
    surface = segment(image, TOLERANCE)
    for i in range(35):
        memory.update(i / 30, image, np.eye(4), board, surface)
    memory.apply_correction(correction)
    frame = 35 / 30, image, correction, surface, sigma, board
    assert memory.settled(*frame)[board].mean() > 0.9
    assert memory.last_dynamic(image, correction)[board].mean() > 0.9
    assert not free_space(memory, 35 / 30, image, correction).any()
    memory.apply_correction(correction)
    assert not memory.settled(*frame).any()


@pytest.mark.parametrize(("x", "stands"), [(0.0, True), (0.06, False)])
def test_images_are_not_believed_on_a_segment_that_stands_where_the_map_has_it(x, stands):
    """All of it, whereas the map knows a part; if it has moved in its own plane, its texture says so."""
    volume, (seen, board) = TsdfVolume(CAMERA, VolumeConfig(voxel_size=0.02), depth_max=4.0), scene(0.0)
    known = np.where(board & (np.indices(CAMERA.shape)[1] > CAMERA.cx), 0, seen.depth).astype(np.float32)
    grey = np.rint(255 * seen.intensity).astype(np.uint8)
    for n in range(4):
        volume.integrate(Frame(n / 30, known, np.repeat(grey[..., None], 3, axis=2)), np.eye(4))
    detector, (image, board) = DynamicDetector(DynamicsConfig(), SensorConfig()), scene(x)
    surface = detector.segment(lambda: Pyramid([], image), 0.02, now=True)
    moving = detector.detect(volume, image, np.eye(4), 0.2, surface, board).dynamic
    assert not moving[~board].any()
    assert moving[board].mean() < 0.05 if stands else moving[board].all()


def free_space(memory, timestamp, image, T, unknown=0.0):
    """Pixels that single frames have seen to be free, with readings that differ by up to 0.1 m."""
    noise, frames = np.full(CAMERA.shape, 0.1, np.float32), memory.free_space_frames(timestamp, unknown)
    return memory.seen_free(image, T, noise, frames)


def test_single_frames_give_free_space():
    """A moving board in front of a wall, seen by a moving camera, against where both are."""
    memory = TemporalMemory(DynamicsConfig())
    v, u = np.indices(CAMERA.shape)

    def image(camera_x, board_x):
        X = (u - CAMERA.cx) / CAMERA.fx * 2 + camera_x  # in the board's plane
        board = (np.abs(X - board_x) < 0.2) & (np.abs(v - CAMERA.cy) < 40)
        wall = 0.5 + 0.2 * np.sin(12 * ((u - CAMERA.cx) / CAMERA.fx * 3 + camera_x))
        return level(np.where(board, 2.0, 3.0), np.where(board, 0.5, wall)), board, X

    for i in range(16):
        camera_x, board_x = 0.01 * i, -0.3 + 0.05 * i
        seen, board, X = image(camera_x, board_x)
        T = np.eye(4)
        T[0, 3] = camera_x
        if i == 0:
            memory.start(0.0)
        free = free_space(memory, i / 30, seen, T)
        assert not free[~board].any()
        memory.update(i / 30, seen, T, np.zeros_like(board), None)
    new = board & (X > -0.3 + 0.2 + 0.03)  # where it was not in the first frame
    assert free[new].mean() > 0.9
    # another pass over the same frames also compares later ones
    again = TemporalMemory(DynamicsConfig())
    again.import_from(
        memory, {k / 30: np.array([[1, 0, 0, 0.01 * k], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) for k in range(16)}
    )
    seen, board, X = image(0.0, -0.3)
    free = free_space(again, 0.0, seen, np.eye(4))
    assert free[board].mean() > 0.8
    assert not free[~board].any()
    # an older map knows free space itself, unless the camera has turned towards unknown space
    assert not again.free_space_frames(10.0, unknown=0.05)
    assert not again.free_space_frames(10.0, unknown=0.5)  # not from the first seconds
    for i in range(16):
        seen, board, X = image(0.0, -0.3 + 0.05 * i)
        free = free_space(again, 10.0 + i / 30, seen, np.eye(4), unknown=0.5)
        assert not again.free_space_frames(10.0 + i / 30, unknown=0.05)
        again.update(10.0 + i / 30, seen, np.eye(4), np.zeros_like(board), None)
    assert free[board & (X > -0.3 + 0.2 + 0.03)].mean() > 0.9
    assert not free[~board].any()


def overlaps(sequence, frames):
    """Overlap of found and true mask, and share of the image that is called moving without cause, by frame."""
    slam, score, wrong = Slam(sequence.camera), [], []
    for i in range(frames):
        found, truth = slam.process(sequence[i]).dynamic_mask, sequence.mask(i)
        score.append((found & truth).sum() / max((found | truth).sum(), 1) if truth.mean() > 0.01 else np.nan)
        wrong.append((found & ~truth).mean())
    return np.array(score), np.array(wrong)


@pytest.mark.slow
def test_a_slow_object_is_labelled_whole():
    sequence = synthetic.sequence("yard", movers=("creeper",), frames=80, seed=2, noise="realsense", camera=SMALL)
    score, _ = overlaps(sequence, 80)
    seen = np.flatnonzero(~np.isnan(score))[0]
    assert np.nanmean(score[seen + 30 :]) >= 0.7


@pytest.mark.slow
def test_a_mapped_object_that_starts_is_labelled_whole():
    sequence = synthetic.sequence("room", situation="starts", frames=90, camera=SMALL)
    score, wrong = overlaps(sequence, 75)
    begun = np.flatnonzero(~np.isnan(score))[0]
    assert np.mean(score[begun + 18 :]) >= 0.7  # the first frames of a smooth start are slower than 5 cm/s
    assert np.mean(wrong) < 0.005


@pytest.mark.slow
def test_an_object_that_stops_becomes_static_after_the_settle_time():
    sequence = synthetic.sequence("room", situation="stops", frames=160, camera=SMALL)
    slam, rest, released = Slam(sequence.camera), None, None
    for i in range(160):
        found, truth = slam.process(sequence[i]).dynamic_mask, sequence.mask(i)
        if truth.mean() > 0.01:
            rest = i
        if rest is not None and i > rest + 5 and released is None and found.mean() < 0.005:
            released = i
    assert released is not None
    assert 0.8 < (released - rest) / 30 < slam.config.dynamics.settle_time + 0.7


@pytest.mark.parametrize(
    ("share", "before", "distance", "mismatch", "whole"),
    [
        (0.5, 0.0, 0.3, 0.4, True),  # the rest has moved by 0.4 pixels
        (0.5, 0.0, 1.1, 0.1, True),  # or by 1.1 standard deviations
        (0.5, 0.0, 0.3, 0.1, False),
        (0.5, 0.0, 0.3, 0.27, False),
        (0.5, 1.0, 0.3, 0.27, True),  # it goes on moving
        (0.1, 1.0, 1.1, 0.4, False),  # nothing moves by itself
        (0.9, 0.0, 0.3, 0.1, True),
    ],
)
def test_motion_is_decided_per_segment(share, before, distance, mismatch, whole):
    """A segment some of which moves is dynamic if the rest of it fits less well than static segments do."""
    evidence = np.array([[0.0] * 5, [500, 1, share, distance, mismatch], [20000, 1, 0, 0.1, 0.05]])
    found = classify_segments(evidence, np.array([0.0, before, 0]), 60.0)
    assert found.tolist() == [False, whole, False]


def test_a_large_segment_moves_only_if_nearly_all_of_it_does():
    for share, whole in ((0.5, False), (0.9, True)):
        evidence = np.array([[0.0] * 5, [5000, 1, share, 3, 1], [15000, 1, 0, 0.1, 0.05]])
        assert classify_segments(evidence, np.zeros(3), 60.0).tolist() == [False, whole, False]


def test_the_gradient_does_not_depend_on_where_the_memory_lies():
    """Some functions of OpenCV round otherwise in the last bit where an array begins at another address."""
    rng = np.random.default_rng(0)
    image = level(np.ones((120, 160), np.float32), rng.random((120, 160), np.float32))
    kept, found = [], set()
    for number in range(60):
        kept += [np.empty(16 * number + 8, np.uint8), intensity_gradient(image)]
        found.add(kept[-1].tobytes())
    assert len(found) == 1
