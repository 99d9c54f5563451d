"""Omitted work: its effect on labels, map, poses and moving objects, against exact truth."""

from itertools import pairwise

import numpy as np
import pytest
from test_segments import TOLERANCE, scene

from dudmap.config import DynamicsConfig
from dudmap.core.dynamics.segments import segment
from dudmap.core.dynamics.temporal_memory import TemporalMemory
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.shed import Shed
from dudmap.core.slam import Slam
from dudmap.evaluation.segmentation import mask_iou
from dudmap.lab import synthetic
from off_course import LIMIT, off_course

CAMERA = Camera(262.5, 262.5, 159.5, 119.5, 320, 240)
YOUNG, OMITTED, FRAMES = 32, 55, 57
"""Frames of the young map, at 30 Hz; frames until nothing is omitted; all frames."""
ALL = Shed.MOVERS | Shed.LABELS | Shed.FUSION


@pytest.fixture(scope="module")
def shed():
    """A room that a mover enters once the map is complete: each frame with its result and the IoU of its mask."""
    sequence = synthetic.sequence("room", frames=FRAMES, camera=CAMERA, noise="none")
    slam, results, ious = Slam(CAMERA), [], []
    for number in range(FRAMES):
        slam.shed = Shed.NOTHING if number >= OMITTED else ALL
        results.append(slam.process(sequence[number]))
        truth = sequence.mask(number)
        large = truth.mean() > 0.02  # of a smaller mover, the rim is most
        ious.append(mask_iou(results[-1].dynamic_mask, truth) if large else np.nan)
    return sequence, results, np.array(ious)


def test_the_young_map_is_labelled_in_full(shed):
    _, results, _ = shed
    assert not any(Shed.LABELS in result.shed for result in results[: YOUNG - 2])


def test_every_second_frame_is_not_fused_and_no_redundant_view(shed):
    _, results, _ = shed
    found = [(Shed.FUSION in result.shed, result.fused, result.reasons) for result in results[1:OMITTED]]
    pair = {(False, True, ()), (True, False, ("no time to fuse the frame",))}
    assert all(set(two) == pair for two in pairwise(found))


def test_work_is_omitted_after_a_gap_that_overload_makes():
    """Every second frame is dropped: 0.07 s between frames."""
    sequence = synthetic.sequence("room", frames=YOUNG + 20, camera=CAMERA, noise="none")
    slam, found = Slam(CAMERA), []
    slam.shed = ALL
    for number in (*range(YOUNG), *range(YOUNG, YOUNG + 20, 2)):
        found.append(slam.process(sequence[number]).shed)
    assert all({one, other} == {Shed.MOVERS, ALL} for one, other in pairwise(found[-8:]))


def test_labels_are_carried_while_most_of_a_mover_has_not_left_its_place():
    memory, (image, board) = TemporalMemory(DynamicsConfig()), scene(0.0)
    assert not memory.can_carry(image, np.eye(4)), "there is no last frame"
    memory.update(0.0, image, np.eye(4), np.zeros_like(board), segment(image, TOLERANCE))
    assert memory.can_carry(image, np.eye(4)), "nothing moves"
    memory.update(0.1, image, np.eye(4), board, segment(image, TOLERANCE))
    assert memory.can_carry(scene(0.3)[0], np.eye(4)), "5/8 of the board overlap"
    assert not memory.can_carry(scene(0.5)[0], np.eye(4)), "3/8 of the board overlap"
    assert not memory.can_carry(image, se3.exp(np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0]))), "the camera moved with it"


def test_two_of_three_frames_omit_most(shed):
    sequence, _, _ = shed
    slam = Slam(CAMERA)
    slam.shed = Shed.FUSION | Shed.MOST
    fused = [slam.process(sequence[number]).fused for number in range(10)]
    assert fused == [True, False, False] * 3 + [True]


def test_carried_labels_cover_the_mover(shed):
    _, results, ious = shed
    carried = np.array([Shed.LABELS in result.shed for result in results]) & ~np.isnan(ious)
    assert carried.sum() >= 5
    assert ious[carried].min() > 0.6, "a mover that enters has 0.7 of its final area in the last frame"
    assert ious[carried].mean() > 0.75
    assert np.nanmean(ious[~carried]) > 0.8


def test_the_pose_does_not_suffer(shed):
    sequence, results, _ = shed
    assert off_course(sequence.ground_truth.Ts_world_camera, [r.T_world_camera for r in results]) < LIMIT


def test_moving_objects_return(shed):
    _, results, _ = shed
    assert not any(result.movers for result in results[1:OMITTED])
    assert all(result.movers for result in results[OMITTED:])
