"""Call the stages of ``Slam`` by hand: prepare, track, fuse. The poses equal a ``Slam`` without labels and places."""

from dudmap import Camera, Config, Frame, Slam, TsdfVolume, synthetic
from dudmap.core.frames.observation import Pyramid, exposed_color
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.geometry.se3 import difference
from dudmap.core.tracking.motion_model import MotionModel
from dudmap.core.tracking.tracker import Tracker

camera = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
sequence = synthetic.sequence("room", movers=(), frames=8, camera=camera, noise="kinect")
sections = "dynamics", "similarity", "relocalization", "loops", "submaps"
config = Config().override([f"{section}.enabled=false" for section in sections])
prepare, motion = Preprocessor(camera, config.preprocess, sensor=config.sensor), MotionModel(config.tracker)
tracker = Tracker(config.tracker, config.sensor, config.preprocess.smoothing_px)
volume = TsdfVolume(camera, config.volume, config.sensor, config.preprocess.depth_max)
slam = Slam(camera, config, live=True)
for frame in sequence:
    image = prepare(frame)
    *coarse, fine = Pyramid.of(image, camera, config).tracked
    T_world_camera, exposure = motion.predict(image.timestamp), (1.0, 0.0)
    if not volume.is_empty:
        start = tracker.minimize(volume, coarse, T_world_camera)
        found = tracker.align(volume, [coarse[-1], fine], start.T_world_camera, None, 1, start.exposure)
        T_world_camera, exposure = found.T_world_camera, found.exposure
    motion.update(image.timestamp, T_world_camera)
    volume.integrate(Frame(image.timestamp, image.depth, exposed_color(image.rgb, exposure)), T_world_camera)
    expected = slam.process(frame).T_world_camera
    assert expected is not None
    print("difference from Slam: {} m, {} deg".format(*difference(T_world_camera, expected)))
