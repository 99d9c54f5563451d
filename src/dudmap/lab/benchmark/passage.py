"""Synthetic recording of a walk through a long passage, in which the camera always sees new space."""

import numpy as np

from dudmap.core.geometry.trajectory import Trajectory
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA, SyntheticSequence
from dudmap.lab.synthetic.scene import Light, Material, Scene, box, cylinder, look_at, pose

SPEED, FPS = 0.3, 30.0
"""Speed of the camera, m/s, and frame rate, Hz."""
LAP = 194
"""Period in frames of the sway of the camera and of the objects along the walls (up to their pattern of three).

60 frames of warm-up and ten periods are 2000 frames: the first and the last tenth show the same, nine periods apart.
"""
SPACING = SPEED * LAP / FPS
"""Distance that the camera covers in one period, metres."""
BEYOND = 8.0
"""Length of the passage beyond the last camera position, metres; its end is out of range."""


def passage(frames: int) -> SyntheticSequence:
    """Recording of ``frames`` frames in which the camera moves straight on and looks at either wall in turn.

    The passage is 3 m wide and as long as the walk, with pilasters, boxes and columns along both walls.
    """
    times = np.arange(frames) / FPS
    length = SPEED * float(times[-1]) + BEYOND
    poses = np.array([_pose(t) for t in times])
    return SyntheticSequence(
        _scene(length), [], Trajectory(times, poses), DEFAULT_CAMERA, noise="kinect", seed=0, fps=FPS
    )


def _pose(t: float) -> np.ndarray:
    sway = np.sin(2 * np.pi * FPS / LAP * t)
    x, y, z = 0.1 * sway, SPEED * t, 1.4 + 0.05 * sway
    aside = 0.9 * sway
    return look_at((x, y, z), (x + aside, y + 1.6, 1.0))


def _scene(length: float) -> Scene:
    middle = length / 2 - 1.0
    solids = [
        box((0, middle, -0.1), (3.4, length + 2, 0.2), Material("checks", (0.4, 0.4))),
        box((0, middle, 2.6), (3.4, length + 2, 0.2), Material("plaster", (0.5, 0.5))),
        box((0, length, 1.25), (3.4, 0.2, 2.5), Material("brick", (0.6, 0.6))),
    ]
    for side, texture in ((-1, "wallpaper"), (1, "brick")):
        solids.append(box((side * 1.6, middle, 1.25), (0.2, length + 2, 2.5), Material(texture, (0.5, 0.5))))
        for number, y in enumerate(np.arange(0.8 + 0.4 * side, length, SPACING)):
            height = 0.4 + 0.25 * (number % 3)
            solids.append(box((side * 1.25, y, height / 2), (0.5, 0.6, height), Material("wood", (0.6, 0.6))))
            solids.append(box((side * 1.45, y + 1.2, 1.25), (0.2, 0.3, 2.5), Material("plaster", (0.8, 0.8))))
            if number % 3:
                top, bottom = (side * 1.1, y + 0.7, 0.9), (side * 1.1, y + 0.7, 0.0)
                solids.append(cylinder(bottom, top, 0.12, Material("stripes", (3, 3))))
    return Scene(
        name="passage",
        primitives=solids,
        home=look_at((0.0, 0.0, 1.4), (0.0, 2.0, 1.0)),
        target=(0.0, 2.0, 1.0),
        space=((-1.0, -0.5, 0.8), (1.0, length, 2.1)),
        extent=((-1.5, -1.0, 0.0), (1.5, length, 2.5)),
        walk_line=((-1.0, 2.0), (1.0, 2.0)),
        rest=pose((0.4, 2.0, 0.0)),
        hinge=pose(),
        lights=tuple(Light((0.0, float(y), 2.4)) for y in np.arange(1.0, length, 4.0)),
    )
