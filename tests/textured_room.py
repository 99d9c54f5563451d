"""A run and its recording of two walls with known colours, written without the code under test.

Every row of an image has its own pose (rolling shutter), the lens is distorted, and exposures differ.
"""

from pathlib import Path

import cv2
import numpy as np

from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory

LENS = (0.08, -0.03, 0.001, -0.002)
CAMERA = Camera(150.0, 150.0, 79.5, 59.5, 160, 120, depth_scale=5000.0)
BACK, SIDE, SCREEN = 2.0, 0.9, 1.1
"""Depth of the back wall, x of the side wall, and depth of the occluder, metres."""
PERIOD, SPACING = 0.12, 0.1
"""Period of the pattern, and distance of the mesh's vertices, whose colours are its mean, metres."""
EXPOSURES = 1.0, 0.8, 1.1, 0.9, 1.0, 0.75, 1.15
SPEED = np.array([0.3, -0.1, 0.05])
READOUT = 0.03
RED = 250, 20, 20


def truth(points: np.ndarray, pattern: float = 45) -> np.ndarray:
    """Colours (..., 3) of points on the walls, 0 to 255; ``pattern`` is the amplitude of the fine pattern."""
    x, y, z = np.moveaxis(points, -1, 0)
    waves = np.sin(2 * np.pi * (x + z) / PERIOD) * np.sin(2 * np.pi * y / PERIOD)
    broad = np.stack([np.sin(1.3 * x + 0.4), np.cos(1.1 * y), np.sin(0.9 * z + x)], axis=-1)
    return 120 + pattern * waves[..., None] + 25 * broad


def position(time) -> np.ndarray:
    """Camera position at times (...,); it never turns."""
    return np.array([-0.25, 0.1, 0.0]) + np.multiply.outer(np.asarray(time), SPEED)


def shot(time: float, *, lens: bool, readout: float, screen: tuple[float, float] | None):
    """Colour as floats, depth, and mask of the occluder between two x coordinates (of the first column of rays)."""
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width].astype(np.float64)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    coefficients = np.array(LENS if lens else (0.0,) * 4)
    rays = cv2.undistortPoints(pixels, CAMERA.K, coefficients)
    rays = np.dstack([rays.reshape(*CAMERA.shape, 2), np.ones(CAMERA.shape)])
    origin = position(time + readout * (v / CAMERA.height - 0.5))
    with np.errstate(divide="ignore"):
        to_side = np.where(rays[..., 0] > 1e-9, (SIDE - origin[..., 0]) / rays[..., 0], np.inf)
    depth = np.minimum(BACK - origin[..., 2], to_side)
    color = truth(origin + depth[..., None] * rays)
    mask = np.zeros(CAMERA.shape, bool)
    if screen is not None:
        at = origin[..., 0] + (SCREEN - origin[..., 2]) * rays[..., 0]
        mask = (at > screen[0]) & (at < screen[1]) & (SCREEN - origin[..., 2] < depth)
        depth = np.where(mask, SCREEN - origin[..., 2], depth)
        color = np.where(mask[..., None], RED, color)
    return color, depth.astype(np.float32), mask


def walls() -> Mesh:
    """Both walls as grids that meet in the corner."""
    parts = []
    for name in ("back", "side"):
        a, b = np.meshgrid(np.arange(-14, 10) * SPACING, np.arange(-9, 10) * SPACING, indexing="ij")
        if name == "back":
            points = np.stack([a, b, np.full_like(a, BACK)], axis=-1)
            points = points[points[:, 0, 0] < SIDE + 1e-6]
            normal = (0, 0, -1)
        else:
            points = np.stack([np.full_like(a, SIDE), b, BACK - 1.4 - a], axis=-1)
            points = points[(points[:, 0, 2] < BACK + 1e-6) & (points[:, 0, 2] > 0.8)][::-1]
            normal = (-1, 0, 0)
        n, m = points.shape[:2]
        grid = np.arange(n * m).reshape(n, m)
        p, q, r, s = (grid[i : n - 1 + i, j : m - 1 + j].ravel() for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
        faces = np.concatenate([np.stack([p, r, q], axis=1), np.stack([p, s, r], axis=1)])
        vertices = points.reshape(-1, 3)
        a0, b0, c0 = (vertices[faces[0, k]] for k in range(3))
        if np.cross(b0 - a0, c0 - a0) @ normal < 0:
            faces = faces[:, ::-1]
        parts.append((vertices, faces, np.tile(np.float32(normal), (n * m, 1))))
    (one, first, up), (other, second, left) = parts
    vertices = np.concatenate([one, other])
    faces = np.concatenate([first, second + len(one)]).astype(np.int32)
    colors = np.rint(truth(vertices, pattern=0)).astype(np.uint8)
    return Mesh(vertices.astype(np.float32), faces, colors, np.concatenate([up, left]))


def write(where: Path, *, lens: bool = False, readout: float = 0.0, screen: bool = False, masked: bool = True) -> Path:
    """Folders ``run`` and ``recording``; an occluder stands in a third of the frames if ``screen``."""
    run, recording = where / "run", where / "recording"
    (run / "masks").mkdir(parents=True)
    recording.mkdir()
    lines, stamps = [], np.arange(len(EXPOSURES)) * 0.4 + 10
    for number, (stamp, exposure) in enumerate(zip(stamps, EXPOSURES, strict=True)):
        place = (-0.3, 0.15) if screen and number % 3 == 1 else None
        color, depth, mask = shot(stamp - stamps[0], lens=lens, readout=readout, screen=place)
        image = np.clip(np.rint(color * exposure), 0, 255).astype(np.uint8)
        cv2.imwrite(str(recording / f"{number}.png"), image[..., ::-1])
        cv2.imwrite(str(recording / f"{number}.depth.png"), np.rint(5000 * depth).astype(np.uint16))
        cv2.imwrite(str(run / "masks" / f"{stamp:.6f}.png"), 255 * (mask & masked).astype(np.uint8))
        lines.append(f"{stamp:.6f} {number}.png {stamp:.6f} {number}.depth.png")
    (recording / "associations.txt").write_text("\n".join(lines) + "\n")
    numbers = ["fx 150", "fy 150", "cx 79.5", "cy 59.5", "width 160", "height 120", "depth_scale 5000"]
    numbers += [f"{name} {value}" for name, value in zip(("k1", "k2", "p1", "p2"), LENS, strict=True)] if lens else []
    (recording / "intrinsics.txt").write_text("\n".join(numbers) + "\n")
    camera = Camera(150.0, 150.0, 79.5, 59.5, 160, 120, distortion=LENS if lens else ())
    Calibration(camera, depth_readout=readout).save(run / "calibration.toml")
    times = np.append(stamps, stamps[-1] + 0.4)  # velocities are known at the last frame too
    Ts = np.tile(np.eye(4), (len(times), 1, 1))
    Ts[:, :3, 3] = position(times - stamps[0])
    Trajectory(times, Ts).save(run / "trajectory.txt")
    walls().save(run / "mesh.ply")
    return run
