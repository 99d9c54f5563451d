"""Images, poses and expectations of the folders that ``layouts.py`` and ``device_layouts.py`` write."""

import json
import struct
import zlib
from dataclasses import dataclass, field

import cv2
import numpy as np


def rotation(axis, angle):
    return cv2.Rodrigues(np.array(axis, float) / np.linalg.norm(axis) * angle)[0]


def pose(k):
    """True T_world_camera of frame k, axes x right, y down, z forward."""
    T = np.eye(4)
    T[:3, :3] = rotation([0.3, 1.0, -0.2], 0.1 + 0.2 * k)
    T[:3, 3] = [0.1 * k, -0.2 + 0.05 * k, 0.3 * k]
    return T


def quat_xyzw(R):
    w = np.sqrt(1 + np.trace(R)) / 2
    return np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 4 * w * w]) / (4 * w)


def tum_line(first, T):
    numbers = [*T[:3, 3], *quat_xyzw(T[:3, :3])]
    return f"{first} " + " ".join(f"{number:.9f}" for number in numbers) + "\n"


def color(k, width=64, height=48):
    """RGB image, smooth so that JPEG keeps it; red, green and blue differ."""
    x, y = np.meshgrid(np.arange(width) / width, np.arange(height) / height)
    return np.stack([60 + 100 * x + 10 * k, 40 + 60 * y, np.full_like(x, 200)], axis=-1).astype(np.uint8)


def millimetres(k, width=64, height=48):
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    depth = (1000 + 100 * k + 3 * (x % 50) + 2 * (y % 30)).astype(np.uint16)
    depth[:5, :7] = 0
    return depth


def write_color(path, k, width=64, height=48):
    path.parent.mkdir(parents=True, exist_ok=True)
    options = [cv2.IMWRITE_JPEG_QUALITY, 98] if path.suffix == ".jpg" else []
    assert cv2.imwrite(str(path), color(k, width, height)[..., ::-1], options)


def write_depth(path, k, scale=1000.0, width=64, height=48, missing=0):
    path.parent.mkdir(parents=True, exist_ok=True)
    depth = np.round(millimetres(k, width, height) * (scale / 1000)).astype(np.uint16)
    depth[:5, :7] = missing
    assert cv2.imwrite(str(path), depth)


def exr(channels, compression=3, window=(0, 0)):
    """Bytes of an OpenEXR image in lines with these channels (H, W) by name, compressed by ZIP (3), ZIPS (2) or not."""
    height, width = next(iter(channels.values())).shape
    kinds = {"uint32": 0, "float16": 1, "float32": 2}
    listed = b"".join(
        name.encode() + struct.pack("<xi4x2i", kinds[str(values.dtype)], 1, 1)
        for name, values in sorted(channels.items())
    )
    box = struct.pack("<4i", *window, window[0] + width - 1, window[1] + height - 1)
    fields = {
        "channels": ("chlist", listed + b"\0"), "compression": ("compression", bytes([compression])),
        "dataWindow": ("box2i", box), "displayWindow": ("box2i", box), "lineOrder": ("lineOrder", b"\0"),
    }  # fmt: skip
    head = b"v/1\x01\x02\0\0\0" + b"".join(
        f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value for name, (kind, value) in fields.items()
    )
    step, blocks = 16 if compression == 3 else 1, []
    for first in range(0, height, step):
        lines = range(first, min(first + step, height))
        raw = b"".join(values[y].tobytes() for y in lines for _, values in sorted(channels.items()))
        halves = np.frombuffer(raw[::2] + raw[1::2], np.uint8).astype(int)
        differences = np.concatenate([halves[:1], (np.diff(halves) + 128) % 256]).astype(np.uint8)
        packed = zlib.compress(differences.tobytes())
        block = packed if compression and len(packed) < len(raw) else raw
        blocks.append(struct.pack("<2i", window[1] + first, len(block)) + block)
    start = len(head) + 1 + 8 * len(blocks)
    places = [start + sum(map(len, blocks[:k])) for k in range(len(blocks))]
    return head + b"\0" + struct.pack(f"<{len(places)}Q", *places) + b"".join(blocks)


def rows(matrix):
    return "\n".join(" ".join(f"{number:.9f}" for number in row) for row in matrix) + "\n"


@dataclass
class Layout:
    """What a written folder must be read as."""

    format: str
    intrinsics: tuple
    shape: tuple = (48, 64)
    stamps: list = field(default_factory=lambda: [0.0, 1 / 30, 2 / 30])
    truth: list | None = field(default_factory=lambda: [pose(k) for k in range(3)])
    numbers: list = field(default_factory=lambda: [0, 1, 2])
    color: tuple | None = None  # fx, fy, cx, cy, shape of a camera of its own
    T_color_depth: np.ndarray = field(default_factory=lambda: np.eye(4))
    name: str = ""  # of the folder, where the layout prescribes one


def open3d_camera(**changes):
    matrix = [60.0, 0, 0, 0, 61.0, 0, 31.0, 23.0, 1.0]  # column by column
    return json.dumps({"width": 64, "height": 48, "intrinsic_matrix": matrix} | changes)
