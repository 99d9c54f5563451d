"""Which of two poses explains an image better, against a tracker that counts pixels."""

from types import SimpleNamespace

import numpy as np

from dudmap.config import Config
from dudmap.core.frames.observation import Level
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import FREE, SURFACE
from dudmap.core.tracking.motion_model import MotionModel
from dudmap.core.tracking.pose_prediction import PosePredictor

CAMERA = Camera(20.0, 20.0, 15.5, 11.5, 32, 24)
PLAIN = Level(CAMERA, np.ones(CAMERA.shape, np.float32), np.zeros(CAMERA.shape, np.float32))


def test_readings_in_free_space_speak_for_no_pose():
    """Half of the view has left its place in the map and would fit at the second pose, the other half at the first."""
    config, (here, there) = Config(), (np.eye(4), np.diag([1.0, 1, 1, 2]))
    person = np.indices(CAMERA.shape)[1] < 20
    occupancy = np.where(person, FREE, SURFACE).astype(np.uint8)
    volume = SimpleNamespace(look_at=lambda T: None, sample=lambda *_: SimpleNamespace(occupancy=occupancy))

    def linearize(volume, level, T, weights):
        return SimpleNamespace(cost=float(weights[person if T is here else ~person].sum()))

    predictor = PosePredictor(config, MotionModel(config.tracker), SimpleNamespace(linearize=linearize), {})
    assert predictor.fits_better(volume, here, there, PLAIN, None)
    assert not predictor.fits_better(volume, there, here, PLAIN, None)
    occupancy[:] = SURFACE  # the larger half decides where none of it is known to have moved
    assert not predictor.fits_better(volume, here, there, PLAIN, None)
