"""Conventions of poses, and a test which fits the images."""

from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError, DatasetError, FrameError

if TYPE_CHECKING:
    from dudmap.core.geometry.camera import Camera
    from dudmap.io.sequences import Sequence

AXES = {
    "opengl": np.diag([1.0, -1, -1, 1]),
    "ros": np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]),
}
"""Camera axes (x right, y up, z back; x forward, y left, z up) in dudmap's."""
WORDS = {
    "world-to-camera": "inverse poses",
    "opengl": "camera x right, y up, z back",
    "ros": "camera x forward, y left, z up",
    "wxyz": "quaternions with w in the other place",
    "millimetres": "positions in millimetres",
}
"""Words of ``--poses-as``."""
PAIRS = 12
TURN, STEP = 8.0, 0.15
"""Least motion of a pair, degrees or metres."""
FURTHEST = 90
"""Largest number of frames between a pair."""
FARTHEST = 50.0
"""Extent of positions, metres, beyond which they may be millimetres."""
STRIDE = 6
TOLERANCE = 0.03
"""Difference of agreeing depths, metres at 1 m and in proportion."""
CLEARLY = 0.12
"""Mean share of pixels by which another convention fits better: three times its spread."""
MOSTLY = 0.8
"""Share of pairs that it fits better."""
HARDLY = 0.15
"""Smallest share of agreeing pixels of poses that belong to the images."""


class Convention(NamedTuple):
    """Convention of poses by keys of ``WORDS``."""

    inverse: bool = False
    axes: str = ""
    wxyz: bool = False
    millimetres: bool = False

    def __str__(self) -> str:
        words = ("world-to-camera", self.inverse), (self.axes, self.axes), ("wxyz", self.wxyz)
        return ",".join(name for name, used in (*words, ("millimetres", self.millimetres)) if used)

    def poses(self, Ts: NDArray[np.float64]) -> NDArray[np.float64]:
        """Poses (N, 4, 4), read as camera-to-world, in dudmap's convention."""
        Ts = Ts.copy()
        if self.wxyz:
            quats = [np.roll(se3.rotation_to_quat_xyzw(R), -1) for R in Ts[:, :3, :3]]
            Ts[:, :3, :3] = [se3.quat_xyzw_to_rotation(quat) for quat in quats]
        if self.millimetres:
            Ts[:, :3, 3] /= 1000
        if self.inverse:
            Ts = se3.inverse(Ts)
        return Ts @ AXES[self.axes] if self.axes else Ts


USED = Convention()


def named(words: list[str]) -> Convention:
    """The convention of words of ``--poses-as``.

    Raises:
        ConfigError: An unknown word, or two kinds of axes.
    """
    axes = [word for word in words if word in AXES]
    if set(words) - set(WORDS) or len(axes) > 1:
        known = ", ".join(f"{word} ({meaning})" for word, meaning in WORDS.items())
        raise ConfigError(f"found --poses-as {','.join(words)}; expected tum, euroc or kitti, and of {known}")
    inverse, wxyz, millimetres = (word in words for word in ("world-to-camera", "wxyz", "millimetres"))
    return Convention(inverse, axes[0] if axes else "", wxyz, millimetres)


def converted(poses: Trajectory, convention: Convention) -> Trajectory:
    """Poses, read as camera-to-world, in dudmap's convention."""
    return Trajectory(poses.timestamps, convention.poses(poses.Ts_world_camera), poses.remarks)


def check_convention(poses: Trajectory, sequence: "Sequence", name: str, read_as: Convention) -> None:
    """Compare depth images of pairs of frames by poses in every convention.

    Raises:
        DatasetError: Another convention fits clearly better, or the poses hardly fit.
    """
    number_of = {float(stamp): number for number, stamp in enumerate(sequence.timestamps)}
    suspected = bool(np.ptp(poses.Ts_world_camera[:, :3, 3], axis=0).max() > FARTHEST)
    pairs = _pairs(converted(poses, Convention(millimetres=suspected)))
    images = {}
    for index in {index for pair in pairs for index in pair}:
        try:
            images[index] = np.asarray(sequence[number_of[float(poses.timestamps[index])]].depth, np.float32)
        except FrameError:
            images[index] = np.zeros(sequence.camera.shape, np.float32)
    if not pairs:
        return
    chosen = sorted(images)
    place = {index: number for number, index in enumerate(chosen)}
    ways = product((False, True), ("", *AXES), (False, True), (False, True) if suspected else (False,))
    options = [Convention(*way) for way in ways]
    shares = {}
    for convention in options:
        Ts = convention.poses(poses.Ts_world_camera[chosen])
        shares[convention] = np.array(
            [
                _agreeing(images[i], images[j], se3.inverse(Ts[place[i]]) @ Ts[place[j]], sequence.camera)
                for i, j in pairs
            ]
        )
    best = max(options, key=lambda option: float(shares[option].mean()))
    given, found = shares[USED], shares[best]
    if (found - given).mean() > CLEARLY and np.mean(found > given) >= MOSTLY:
        said = f"read as {read_as}" if read_as != USED else "read as camera-to-world, camera x right, y down, z forward"
        change = f"they fit as {best}" if read_as == USED else f"from there they fit as {best}"
        mend = f"give --poses-as {best}" if read_as == USED else "leave out or correct --poses-as"
        raise DatasetError(
            f"the poses of {name} contradict the images: {said}, the depths of two images agree at "
            f"{given.mean():.0%} of the pixels; {change} ({found.mean():.0%}); {mend}"
        )
    if given.mean() < HARDLY:
        raise DatasetError(
            f"the poses of {name} contradict the images in every known convention: the depths of two images agree at "
            f"{given.mean():.0%} of the pixels; they may be of another recording, camera or clock"
        )


def _pairs(poses: Trajectory) -> list[tuple[int, int]]:
    pairs = []
    for first in np.unique(np.linspace(0, len(poses) - 2, 4 * PAIRS).astype(int)) if len(poses) > 1 else []:
        for last in range(first + 1, min(first + FURTHEST, len(poses))):
            motion = se3.inverse(poses.Ts_world_camera[first]) @ poses.Ts_world_camera[last]
            if np.degrees(se3.rotation_angle(motion)) > TURN or np.linalg.norm(motion[:3, 3]) > STEP:
                pairs.append((int(first), last))
                break
    return pairs[:: -(-len(pairs) // PAIRS) or 1]


def _agreeing(depth: NDArray, other: NDArray, T_camera_other: NDArray[np.float64], camera: "Camera") -> float:
    v, u = np.mgrid[0 : camera.height : STRIDE, 0 : camera.width : STRIDE].reshape(2, -1)
    z = other[v, u].astype(np.float64)
    u, v, z = u[z > 0], v[z > 0], z[z > 0]
    if not len(z):
        return 0.0
    points = camera.points(u, v, z) @ T_camera_other[:3, :3].T + T_camera_other[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = points[:, :2] / points[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    seen = (points[:, 2] > 0.05) & np.all(
        (pixels > -0.5) & (pixels < (camera.width - 0.5, camera.height - 0.5)), axis=1
    )
    columns, rows = np.rint(pixels[seen]).astype(int).T
    found, expected = depth[rows, columns], points[seen, 2]
    return float(np.count_nonzero(np.abs(found - expected) < TOLERANCE * np.maximum(expected, 1)) / len(z))
