"""Five RGB-D cameras as people own them: noise, faults and view, with the source of every value.

Each is described as its driver delivers it: colour registered to depth, so that only what registration leaves over is a
fault of place; add ``color_translation`` and the like for unregistered streams. "Assumed" marks what no publication
was found for; "read" what was compared with the text of the source, "cited" what is quoted from a publication of which
only the abstract could be read.
"""

from dataclasses import dataclass

import numpy as np

from dudmap.core.geometry.camera import Camera
from dudmap.errors import ConfigError
from dudmap.lab.synthetic.faults import SensorFaults


@dataclass(frozen=True)
class CameraModel:
    """One camera.

    Attributes:
        noise: Name of its noise model (``sensors.SENSORS``).
        field_of_view: Horizontal field of view of a 4:3 depth image, degrees.
        motion_blur: Exposure time of the colour as a share of the frame interval.
        faults: Its faults.
    """

    noise: str
    field_of_view: float
    motion_blur: float
    faults: SensorFaults

    def camera(self, width: int, height: int) -> Camera:
        """Intrinsics of an image of this camera's view, with square pixels."""
        focal = width / 2 / np.tan(np.radians(self.field_of_view / 2))
        return Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height, depth_scale=5000.0)


CAMERAS: dict[str, CameraModel] = {
    # View: 57 degrees (manufacturer, assumed). Noise: Khoshelham & Elberink 2012, Accuracy and resolution of Kinect
    # depth data, read: "a few millimetres up to about 4 cm at the maximum range", which 1.425 mm z^2 (cited) gives at 5
    # m. Both shutters are rolling: Ringaby & Forssen 2011, Scan rectification for structured light range sensors with
    # rolling shutters, read; the readout of 26 ms is assumed, and that of the depth is not simulated. Depth distortion:
    # Teichman, Miller & Thrun 2013, Unsupervised intrinsic calibration of depth sensors via SLAM, read: accurate to
    # about three metres, significantly bent beyond, different from one sensor to the next; 1 % at 2 m is assumed.
    # Colour and depth are not synchronised: any delay up to half an interval, 12 ms assumed. Bands, exposure,
    # vignetting, and the rest of the registration assumed.
    "kinect_v1": CameraModel(
        "kinect",
        57.0,
        0.3,
        SensorFaults(
            color_translation=(0.003, 0.0, 0.0),
            color_rotation_deg=(0.1, 0.2, 0.0),
            color_delay=0.012,
            color_readout=0.026,
            auto_exposure=0.3,
            white_balance_drift=0.03,
            vignetting=0.15,
            depth_distortion=0.01,
            depth_bands=0.001,
            dropped_frames=0.02,
        ),
    ),
    # View: 70 degrees (manufacturer, assumed). Noise: Fankhauser et al. 2015, cited. Offset of -18 mm: Wasenmueller &
    # Stricker 2016, Comparison of Kinect v1 and v2 depth images in terms of accuracy and precision, cited; that flying
    # pixels and multi-path occur: there, read. Their shares are assumed, as are delay, readout, exposure and the rest
    # of the registration. The Azure Kinect is another sensor: distance error below 11 mm and standard deviation at most
    # 17 mm up to 3.5 m (Tolgyessy et al. 2021, Sensors 21, 413, read), so about as accurate to 3.5 m without the
    # offset.
    "kinect_v2": CameraModel(
        "kinect_v2",
        70.0,
        0.3,
        SensorFaults(
            color_translation=(0.002, 0.0, 0.0),
            color_rotation_deg=(0.0, 0.15, 0.0),
            color_delay=0.008,
            color_readout=0.02,
            auto_exposure=0.3,
            vignetting=0.1,
            depth_offset=-0.018,
            depth_distortion=0.004,
            flying_pixels=0.5,
            multipath=0.5,
        ),
    ),
    # View: 75 degrees at 4:3 (of 85.2 degrees at 16:9, read, in a table of the D400 series), depth with a global
    # shutter (there, read); colour with a rolling one, and an error of at most 2 % at 2 m: Intel, D400 series
    # datasheet, cited; half of it is taken as scale, the rest as distortion. Noise: Grunnet-Jepsen et al. 2018, see
    # sensors.py. Delay, readout, exposure and the rest of the registration assumed.
    "realsense_d435": CameraModel(
        "d435",
        75.0,
        0.25,
        SensorFaults(
            color_translation=(0.001, 0.0, 0.0),
            color_rotation_deg=(0.1, 0.1, 0.0),
            color_delay=0.005,
            color_readout=0.02,
            auto_exposure=0.2,
            white_balance_drift=0.03,
            vignetting=0.2,
            depth_scale_error=0.01,
            depth_distortion=0.006,
            late_frames=0.02,
        ),
    ),
    # View: 70 x 55 degrees, range 0.25 to 9 m, error of about 5 mm to about 14 mm up to 9 m: Intel's comparison of its
    # cameras, read. Noise: Intel, LiDAR Camera L515 datasheet, revision 003, January 2021, cited. The depth is scanned
    # by a mirror during the frame, which is not simulated. The rest assumed.
    "realsense_l515": CameraModel(
        "l515",
        70.0,
        0.25,
        SensorFaults(
            color_translation=(0.001, 0.001, 0.0),
            color_rotation_deg=(0.1, 0.0, 0.0),
            color_delay=0.005,
            color_readout=0.02,
            auto_exposure=0.2,
            vignetting=0.2,
            depth_offset=0.004,
            depth_distortion=0.002,
            flying_pixels=0.3,
            multipath=0.2,
            late_frames=0.02,
        ),
    ),
    # Depth of 256 x 192 pixels: read in programs that read ARKit's and those of ARKitScenes (Baruch et al. 2021);
    # registered and synchronous: cited from there. Error of about 1 cm: Luetzenburg, Kroon & Bjork 2021, Evaluation of
    # the Apple iPhone 12 Pro LiDAR, cited. View of the wide camera about 60 degrees; JPEG as recording apps store it;
    # readout, exposure and the division of the error assumed.
    "iphone_lidar": CameraModel(
        "iphone",
        60.0,
        0.25,
        SensorFaults(
            color_readout=0.01,
            auto_exposure=0.4,
            white_balance_drift=0.05,
            vignetting=0.1,
            jpeg_quality=85.0,
            depth_scale_error=0.003,
            depth_distortion=0.004,
            late_frames=0.05,
        ),
    ),
}
"""Cameras by name."""


def find_camera(name: str) -> CameraModel:
    """Camera of the given name.

    Raises:
        ConfigError: The name is unknown.
    """
    if name not in CAMERAS:
        raise ConfigError(f"unknown sensor {name!r}; known sensors: {', '.join(CAMERAS)}")
    return CAMERAS[name]
