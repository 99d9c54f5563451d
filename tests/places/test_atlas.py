"""What the atlas knows of the camera's motion."""

import numpy as np

from dudmap.config import Config
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.atlas import Atlas
from dudmap.core.places.place_recognition import KeyframeDatabase

TINY = Camera(fx=32.8, fy=32.8, cx=19.5, cy=14.5, width=40, height=30)
TWIST = np.array([0.3, -0.1, 0.2, 0.5, 0.4, -0.6])


def test_velocity_at_a_frame_is_that_between_the_poses_around_it():
    config = Config()
    atlas = Atlas(lambda: TsdfVolume(TINY), KeyframeDatabase(config.relocalization, TINY, config.sensor), None)
    times = [10.0, 10.03, 10.07, 11.0, 11.03]
    for n, t in enumerate(times):
        if n == 4:
            atlas.current = 1  # another world
        atlas.add_pose(t, se3.exp([0, 0, 0, 0.3, 0, 0]) @ se3.exp(TWIST * (t - 10)))
    for t in times[:3]:  # also at the first, and before a gap
        np.testing.assert_allclose(atlas.velocity_at(t), TWIST, atol=1e-9)
    np.testing.assert_array_equal(atlas.velocity_at(times[3]), np.zeros(6))
    np.testing.assert_array_equal(atlas.velocity_at(times[4]), np.zeros(6))
