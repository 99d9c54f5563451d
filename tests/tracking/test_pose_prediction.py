"""Which of two poses explains an image better, against a tracker that counts pixels."""

from types import SimpleNamespace

import numpy as np
import pytest

from dudmap.config import Config
from dudmap.core.dynamics.ego_motion import SlowMotion
from dudmap.core.frames.observation import Level
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import FREE, SURFACE
from dudmap.core.tracking.frame_view import StageTimer
from dudmap.core.tracking.pose_prediction import MotionModel, PosePredictor

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


@pytest.mark.parametrize(("age", "believed"), [(0.3, True), (0.6, False)])
def test_what_an_older_image_shows_is_not_believed_against_a_map_that_holds_no_slow_motion(monkeypatch, age, believed):
    """The map fits the pose by the last image; before slow motion can be seen it may have been dragged along."""
    config, slow_pose, still = Config(), np.diag([1.0, 1, 1, 2]), np.zeros(CAMERA.shape, bool)
    linearize = lambda volume, level, T, weights: SimpleNamespace(cost=2.0 if T is slow_pose else 1.0)  # noqa: E731
    predictor = PosePredictor(config, MotionModel(config.tracker), SimpleNamespace(linearize=linearize), {})
    surface = np.full(CAMERA.shape, SURFACE, np.uint8)
    volume = SimpleNamespace(look_at=lambda T: None, sample=lambda *_: SimpleNamespace(occupancy=surface))
    predictor.ego_motion.start(0.0)
    predictor.ego_motion.active = True
    motion = SimpleNamespace(T_after_before=np.eye(4), moving_after=still, moving_before=still, static_after=~still)
    slow = SlowMotion(slow_pose, ~still, still, None)
    monkeypatch.setattr(predictor, "_ego_motion", lambda view: motion)
    monkeypatch.setattr(predictor, "_slow_motion", lambda *_: slow)
    pyramid = SimpleNamespace(coarse=PLAIN)
    view = SimpleNamespace(timestamp=age, pyramid=pyramid, labelled=PLAIN, timer=StageTimer())
    prediction = predictor.predict(volume, view, None)
    assert (prediction.T_world_camera is slow_pose) == believed
    assert (prediction.slow is not None) == believed
