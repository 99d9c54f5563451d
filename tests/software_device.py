"""Recordings of librealsense's software device: the driver without a camera."""

import time

import numpy as np
import pytest

from bags import millimetres
from recordings import HEIGHT, WIDTH, color_image

T_COLOR_DEPTH = np.array([[0, -1, 0, 0.015], [1, 0, 0, 0.002], [0, 0, 1, 0], [0, 0, 0, 1.0]])
COLOR_WIDTH = 80


def color(index):
    return np.pad(color_image(index), ((0, 0), (0, COLOR_WIDTH - WIDTH), (0, 0)), mode="edge")


def record(path, frames=6, rate=30):
    """Record frames of a depth and a colour camera with times from 10 s on, as fast as the driver writes them."""
    rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)
    device = rs.software_device()
    sensors = device.add_sensor("Depth"), device.add_sensor("Color")
    depth = sensors[0].add_video_stream(stream(rs, rs.stream.depth, WIDTH, 60.0, rs.format.z16, 2))
    colour = sensors[1].add_video_stream(stream(rs, rs.stream.color, COLOR_WIDTH, 70.0, rs.format.rgb8, 3))
    motion = rs.extrinsics()
    motion.rotation = list(T_COLOR_DEPTH[:3, :3].T.reshape(-1))
    motion.translation = list(T_COLOR_DEPTH[:3, 3])
    depth.as_video_stream_profile().register_extrinsics_to(colour.as_video_stream_profile(), motion)
    sensors[0].add_read_only_option(rs.option.depth_units, 0.001)
    recorder = rs.recorder(str(path), device)
    queue = rs.frame_queue(50)
    recorded = recorder.query_sensors()
    for sensor in recorded:
        sensor.open(sensor.get_stream_profiles()[0])
        sensor.start(queue)
    for index in range(frames):
        stamp = 10_000 + 1000 * index / rate
        send(rs, sensors[0], depth, millimetres(index), index, stamp)
        send(rs, sensors[1], colour, color(index), index, stamp + 5)
        time.sleep(0.03)
    for sensor in recorded:
        sensor.stop()
        sensor.close()
    return path


def stream(rs, kind, width, focal, form, size):
    intrinsics = rs.intrinsics()
    intrinsics.width, intrinsics.height, intrinsics.model = width, HEIGHT, rs.distortion.none
    intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy = focal, focal, width / 2 - 0.5, HEIGHT / 2 - 0.5
    out = rs.video_stream()
    out.type, out.index, out.uid, out.fmt, out.fps, out.bpp = kind, 0, size, form, 30, size
    out.width, out.height, out.intrinsics = width, HEIGHT, intrinsics
    return out


def send(rs, sensor, profile, pixels, number, stamp):
    frame = rs.software_video_frame()
    frame.pixels, frame.bpp = pixels, pixels[0, 0].nbytes
    frame.stride = pixels.shape[1] * frame.bpp
    frame.timestamp, frame.domain = stamp, rs.timestamp_domain.hardware_clock
    frame.frame_number, frame.profile = number, profile.as_video_stream_profile()
    if pixels.ndim == 2:
        frame.depth_units = 0.001
    sensor.on_video_frame(frame)
