"""A cue of the caller: what it says is masked and not fused; what says nothing changes nothing."""

import runpy
from pathlib import Path

import numpy as np

from dudmap import Camera, Slam, synthetic

CAMERA = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
EXAMPLE = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "own_cue.py"))
FRAMES = 8


def processed(sequence, cues):
    slam = Slam(CAMERA, cues=cues)
    return [slam.process(sequence[index]) for index in range(FRAMES)]


def test_a_network_masks_what_stands_still_from_the_second_frame_on():
    room = synthetic.sequence("room", movers=(), frames=FRAMES, camera=CAMERA)
    near = [
        (frame.depth > 0) & (frame.depth < np.quantile(frame.depth, 0.2)) for frame in (room[n] for n in range(FRAMES))
    ]
    found = dict(zip(room.timestamps, (mask.astype(np.float32) for mask in near), strict=True))
    plain = processed(room, ())[-1].dynamic_mask
    masked = processed(room, [EXAMPLE["PersonCue"](found.__getitem__)])[-1].dynamic_mask
    assert near[-1].mean() > 0.05
    assert plain[near[-1]].mean() < 0.05
    assert masked[near[-1]].mean() > 0.9
    assert (masked & ~near[-1]).mean() < 0.1  # the rest of their segments


def test_a_cue_without_evidence_changes_nothing():
    office = synthetic.sequence("room", movers=("person",), frames=FRAMES, camera=CAMERA)
    silent = EXAMPLE["PersonCue"](lambda timestamp: np.zeros(CAMERA.shape, np.float32))
    for plain, cued in zip(processed(office, ()), processed(office, [silent]), strict=True):
        np.testing.assert_array_equal(plain.dynamic_mask, cued.dynamic_mask)
        np.testing.assert_array_equal(plain.T_world_camera, cued.T_world_camera)
