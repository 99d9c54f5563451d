"""Remove dynamic objects from a recording."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.app.views.background import BackgroundRenderer, continued
from dudmap.app.views.hanging import remove_hanging_pieces
from dudmap.app.views.rendering import TumFolder, camera_lines, depth_units
from dudmap.core.frames.frame import Frame
from dudmap.errors import DatasetError, FrameError
from dudmap.io.exporting.run_content import RunContent
from dudmap.io.sequences.images import read_mask

if TYPE_CHECKING:
    from dudmap.io.sequences import Sequence

MARGIN = 6 / 640
"""Growth of masks, share of the width: blur, mixed pixels, disparity window."""
REACH = 24 / 640
"""Distance from a mask, share of the width, of added pixels in front of the map."""
IN_FRONT = 0.04
"""Share in front of the map: 2.5 standard deviations of a Kinect at 5 m (0.0012 m + 0.0019 (z - 0.4)^2)."""
SHADOW = 48 / 640
"""Width of the projector's shadow, share of the width: 0.075 m * 525 / 0.8 m."""
LEFT_OVER = 5.0
"""Colour difference of dynamic pixels near a mask, standard deviations (1.48 median absolute deviations): feet on the
floor."""
LEAST_DIFFERENCE = 40.0
"""Smallest such difference, of 255, above shadows and exposure."""
SOURCES = 150
"""Frames that provide colours, evenly spread; each takes 2 MB."""


class Cleaned(NamedTuple):
    """A frame without dynamic objects.

    Attributes:
        moving: (h, w) bool, replaced pixels of the colour image.
        replaced: (H, W) bool, replaced depth pixels, with shadows.
        color: (h, w, 3) uint8; unknown pixels continue the known.
        depth: (H, W) float32, metres, 0 = unknown.
        known: (h, w) bool, known colours.
    """

    frame: Frame
    moving: NDArray[np.bool_]
    replaced: NDArray[np.bool_]
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    known: NDArray[np.bool_]


@dataclass(frozen=True)
class CleanReport:
    """Result of ``clean``."""

    frames: int
    left_out: tuple[int, ...]
    replaced: float
    unknown: float


class Cleaner:
    """Replaces dynamic objects in a recording, given a run over it with map and masks.

    Attributes:
        indices: Frames with pose and mask.
        registered: Whether the pixels of depth and colour images correspond.

    Raises:
        DatasetError: No masks, poses of another recording, or no pose of the colour camera.
        MapError: There is no map.
    """

    def __init__(self, run: RunContent, sequence: "Sequence") -> None:
        self.run, self.sequence = run, sequence
        self._poses: dict[int, NDArray[np.float64]] = {}
        self._masks: dict[int, Path] = {}
        for index, T_world_camera, mask in run.frames_of(sequence):
            self._poses[index], self._masks[index] = T_world_camera, mask
        self.indices = tuple(self._poses)
        self.registered, color_camera = sequence.calibration is None, run.color_camera(sequence)
        if run.calibration is not None:  # also for registered images whose camera was estimated
            color_camera = run.calibration.camera
        if run.mesh is not None:
            remove_hanging_pieces(run.volume, run.mesh)
        self._renderer = BackgroundRenderer(run.volume, sequence.camera, color_camera, registered=self.registered)
        for index in self.indices[:: max(1, -(-len(self.indices) // SOURCES))]:
            try:
                frame = sequence[index]
            except FrameError:
                continue
            T_world_camera, T_world_color = self._poses[index], self._color_pose(frame)
            moving = self._moving(index, frame, self._renderer.map_depth(T_world_camera))
            moving = self._renderer.in_color(moving, frame, T_world_camera, T_world_color)
            self._renderer.add(frame, moving, T_world_camera, T_world_color)

    def _moving(self, index: int, frame: Frame, behind: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Replaced pixels (H, W): the mask, nearby pixels in front of the map, and a margin."""
        mask, width = read_mask(self._masks[index]), self.sequence.camera.width
        if mask.shape != frame.depth.shape:
            raise DatasetError(f"the masks of {self.run.folder} do not have the size of the frames")
        in_front = (frame.depth > 0) & (frame.depth < (1 - IN_FRONT) * behind)
        return grown(mask | (in_front & grown(mask, REACH * width)), MARGIN * width)

    def clean(self, index: int) -> Cleaned:
        """Remove dynamic objects from frame number ``index``."""
        frame, T_world_camera = self.sequence[index], self._poses[index]
        T_world_color = self._color_pose(frame)
        behind = self._renderer.map_depth(T_world_camera)
        replaced = self._moving(index, frame, behind)
        moving = self._renderer.in_color(replaced, frame, T_world_camera, T_world_color)
        checked, surely = grown(moving, REACH * moving.shape[1]), None
        if self.registered:  # objects too near for the sensor have no depth and are found by their colours
            checked |= connected(replaced, (frame.depth == 0) & (behind > 0))
            surely = (frame.depth > 0) & (np.abs(frame.depth - behind) < IN_FRONT * behind)
        found, seen = self._renderer.colors(frame, checked, T_world_color)
        left = unlike(frame.rgb, found, checked & ~moving & seen, surely)
        if self.registered:
            replaced = replaced | left
        replaced = with_shadow(replaced, frame.depth, behind)
        moving = moving | left
        known = seen | ~moving
        color = continued(np.where((moving & seen)[..., None], found, frame.rgb), known)
        return Cleaned(frame, moving, replaced, color, np.where(replaced, behind, frame.depth), known)

    def _color_pose(self, frame: Frame) -> NDArray[np.float64]:
        return self.run.color_pose(frame.timestamp if frame.color_timestamp is None else frame.color_timestamp)


def grown(mask: NDArray[np.bool_], width: float) -> NDArray[np.bool_]:
    """Mask (H, W) dilated by ``width`` pixels, at least one."""
    import cv2

    radius = max(1, round(width))
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.dilate(mask.astype(np.uint8), disk) > 0


def connected(mask: NDArray[np.bool_], others: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask (H, W) plus connected pixels of ``others``."""
    import cv2

    _, pieces = cv2.connectedComponents((mask | others).astype(np.uint8), connectivity=8)
    touched = np.unique(pieces[mask])
    return np.isin(pieces, touched[touched > 0])


def with_shadow(
    moving: NDArray[np.bool_], depth: NDArray[np.float32], behind: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Mask (H, W) plus connected pixels without depth before known background (H, W): projector shadows."""
    return connected(moving, grown(moving, SHADOW * moving.shape[1]) & (depth == 0) & (behind > 0))


def unlike(
    image: NDArray[np.uint8],
    expected: NDArray[np.uint8],
    where: NDArray[np.bool_],
    surely: NDArray[np.bool_] | None = None,
) -> NDArray[np.bool_]:
    """Pixels (h, w) whose colours (h, w, 3) differ unusually from the expected; tested: ``where``; the spread is that
    of ``surely``, else of all. Single pixels and lines are discarded."""
    import cv2

    judged = where if surely is None or not (where & surely).any() else where & surely
    if not judged.any():
        return where
    difference = np.abs(image.astype(np.float32) - expected).max(axis=2)
    usual = float(np.median(difference[judged]))
    spread = 1.48 * float(np.median(np.abs(difference[judged] - usual)))
    far = where & (difference > max(usual + LEFT_OVER * spread, LEAST_DIFFERENCE))
    blobs = cv2.morphologyEx(far.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return where & grown(blobs > 0, 1)


def clean_recording(
    run: RunContent,
    sequence: "Sequence",
    out: Path,
    progress: "Callable[[int, int], None] | None" = None,
    max_frames: int | None = None,
) -> CleanReport:
    """Write the recording without dynamic objects, in TUM layout, into an empty folder: rgb/, depth/, lists,
    associations.txt, intrinsics.txt, groundtruth.txt if known, and

    - trajectory.txt, the poses of the run.
    - replaced/ with replaced.txt: 255 = replaced pixels.
    - unknown/ with unknown.txt: 255 = background that no frame saw: depth 0, colour of the surroundings.

    A separate colour camera keeps its geometry (intrinsics.txt), with masks replaced_color/ and unknown_color/.
    ``progress`` receives the numbers of finished and all frames.

    Raises:
        DatasetError: The folder is not empty, or run and recording differ.
        MapError: There is no map.
        OSError: A file cannot be written.
    """
    if out.exists() and (not out.is_dir() or any(path.name != "run" for path in out.iterdir())):
        raise DatasetError(f"{out} exists and is not an empty folder; name another one")
    cleaner, camera = Cleaner(run, sequence), sequence.camera
    masks = ("replaced", "unknown") + (() if cleaner.registered else ("replaced_color", "unknown_color"))
    folder = TumFolder(out, f"{sequence.name} without dynamic objects, by dudmap clean", ("rgb", "depth", *masks))
    wanted = range(len(sequence))[:max_frames]
    indices = [index for index in cleaner.indices if index in wanted]
    pairs, shares, left_out = [], [], sorted(set(wanted) - set(indices))
    for done, index in enumerate(indices, start=1):
        try:
            cleaned = cleaner.clean(index)
        except FrameError:
            left_out.append(index)
            continue
        frame = cleaned.frame
        unknown_color, unknown = cleaned.moving & ~cleaned.known, cleaned.replaced & (cleaned.depth == 0)
        images = {"replaced": cleaned.replaced, "unknown": unknown | unknown_color if cleaner.registered else unknown}
        if not cleaner.registered:
            images |= {"replaced_color": cleaned.moving, "unknown_color": unknown_color}
        for kind, image in images.items():
            folder.add(kind, frame.timestamp, image)
        color_time = frame.timestamp if frame.color_timestamp is None else frame.color_timestamp
        color = folder.add("rgb", color_time, cleaned.color)
        pairs.append(f"{color} {folder.add('depth', frame.timestamp, depth_units(cleaned.depth, camera))}")
        shares.append((float(cleaned.moving.mean()), float(unknown_color.mean())))
        if progress is not None:
            progress(done, len(indices))
    lines = []
    if sequence.calibration is not None and run.calibration is not None:
        T = np.linalg.inv(run.calibration.T_color_depth)
        lines = [f"color_{line}" for line in camera_lines(run.calibration.camera)]
        lines.append("T_depth_color " + " ".join(f"{value:.9g}" for value in T.reshape(-1)))
    folder.finish(camera, pairs, lines)
    run.trajectory.save(out / "trajectory.txt")
    if sequence.ground_truth is not None:
        sequence.ground_truth.save(out / "groundtruth.txt")
    replaced, unknown = np.mean(shares, axis=0) if shares else (0.0, 0.0)
    return CleanReport(len(pairs), tuple(sorted(left_out)), float(replaced), float(unknown))
