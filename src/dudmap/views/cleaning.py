"""A recording as it would have been without the things that move."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import write_bytes, write_text
from dudmap.errors import DatasetError, FrameError
from dudmap.exporting.run_content import RunContent
from dudmap.exporting.view_synthesis import index_at
from dudmap.frames.frame import Frame
from dudmap.sequences.images import read_mask
from dudmap.views.background import Background, BackgroundRenderer

if TYPE_CHECKING:
    from dudmap.sequences import Sequence

MARGIN = 6 / 640
"""Width by which masks grow, as a share of the image's: blur, mixed pixels and the disparity window of the sensor."""
REACH = 24 / 640
"""Pixels so near a mask that lie in front of the map belong to it: in a finished map only what moved is in front."""
IN_FRONT = 0.04
"""A reading is in front of the map if it is nearer by this share: 2.5 standard deviations of a Kinect at 5 m
(0.0012 m + 0.0019 (z - 0.4)^2)."""
SOURCES = 150
"""Largest number of frames that lend their colours, spread evenly; 640x480 pixels of one take 2 MB."""


@dataclass(frozen=True)
class CleanReport:
    """What ``clean`` did.

    Attributes:
        frames: Number of frames written.
        left_out: Numbers of the frames without a pose or a readable image.
        replaced: Mean share of the pixels that was replaced.
        unknown: Mean share of the pixels whose background no frame saw.
    """

    frames: int
    left_out: tuple[int, ...]
    replaced: float
    unknown: float


class Cleaner:
    """Replaces what moves in the frames of a recording, given a run over it.

    Args:
        run: The run, with map and masks.
        sequence: The recording, with colour registered to depth.

    Attributes:
        indices: Numbers of the frames that have a pose and a mask.

    Raises:
        DatasetError: The run has no masks, or none of its poses belongs to the recording.
        MapError: There is no map.
    """

    def __init__(self, run: RunContent, sequence: "Sequence") -> None:
        self.run, self.sequence = run, sequence
        masks = run.mask_files()
        stamps = np.array(sorted(masks))
        self._poses: dict[int, NDArray[np.float64]] = {}
        self._masks: dict[int, Path] = {}
        for index, moment in enumerate(sequence.timestamps.tolist()):
            pose, mask = index_at(run.trajectory.timestamps, moment), index_at(stamps, moment)
            if pose is not None and mask is not None:
                self._poses[index] = run.trajectory.Ts_world_camera[pose]
                self._masks[index] = masks[float(stamps[mask])]
        self.indices = tuple(self._poses)
        if not self.indices:
            raise DatasetError(
                f"no frame of {sequence.name} has a pose in {run.folder}; name the run of this recording"
            )
        color_camera = sequence.camera if run.calibration is None else run.calibration.camera
        self._renderer = BackgroundRenderer(run.volume, sequence.camera, color_camera)
        self._is_prepared = False

    def prepare(self) -> None:
        """Read the frames that lend their colours."""
        step = max(1, -(-len(self.indices) // SOURCES))
        for index in self.indices[::step]:
            try:
                frame = self.sequence[index]
            except FrameError:
                continue
            self._renderer.add(frame, self.moving(index, frame), self._color_pose(frame))
        self._is_prepared = True

    def moving(self, index: int, frame: Frame) -> NDArray[np.bool_]:
        """Pixels (H, W) of a frame that are replaced: its mask, what lies in front of the map beside it, and a margin.

        Raises:
            DatasetError: The mask has another size.
        """
        mask, width = read_mask(self._masks[index]), self.sequence.camera.width
        if mask.shape != frame.depth.shape:
            raise DatasetError(f"the masks of {self.run.folder} do not have the size of the frames")
        behind = self._renderer.map_depth(self._poses[index])
        in_front = (frame.depth > 0) & (frame.depth < (1 - IN_FRONT) * behind)
        return grown(mask | (in_front & grown(mask, REACH * width)), MARGIN * width)

    def clean(self, index: int) -> tuple[Frame, NDArray[np.bool_], Background]:
        """Frame number ``index``, what of it is replaced (H, W), and by what."""
        if not self._is_prepared:
            self.prepare()
        frame = self.sequence[index]
        moving = self.moving(index, frame)
        background = self._renderer.render(frame, moving, self._poses[index], self._color_pose(frame))
        return frame, moving, background

    def _color_pose(self, frame: Frame) -> NDArray[np.float64]:
        return self.run.color_pose(frame.timestamp if frame.color_timestamp is None else frame.color_timestamp)


def grown(mask: NDArray[np.bool_], width: float) -> NDArray[np.bool_]:
    """Mask (H, W) grown by about so many pixels, at least one."""
    import cv2

    radius = max(1, round(width))
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.dilate(mask.astype(np.uint8), disk) > 0


def clean_recording(
    run: RunContent, sequence: "Sequence", out: Path, progress: "Callable[[int, int], None] | None" = None
) -> CleanReport:
    """Write the recording without what moves, in TUM layout.

    The folder receives rgb/, depth/, their lists rgb.txt, depth.txt and associations.txt, intrinsics.txt,
    groundtruth.txt if it is known, trajectory.txt (poses of the run), replaced/ and unknown/ (255 = pixels that were
    replaced, and those of them whose background no frame saw: their depth is 0, their colour continues what surrounds
    them), with replaced.txt and unknown.txt.

    Args:
        run: A run over the recording, with map and masks.
        sequence: The recording.
        out: New or empty folder.
        progress: Called with the number of finished frames and of all.

    Raises:
        DatasetError: The folder is not empty, or run and recording do not fit together.
        MapError: There is no map.
        OSError: A file cannot be written.
    """
    if out.exists() and (not out.is_dir() or any(path.name != "run" for path in out.iterdir())):
        raise DatasetError(f"{out} exists and is not an empty folder; name another one")
    cleaner = Cleaner(run, sequence)
    for name in ("rgb", "depth", "replaced", "unknown"):
        (out / name).mkdir(parents=True, exist_ok=True)
    lines: list[tuple[str, str]] = []
    shares, left_out = [], sorted(set(range(len(sequence))) - set(cleaner.indices))
    for done, index in enumerate(cleaner.indices, start=1):
        try:
            frame, moving, background = cleaner.clean(index)
        except FrameError:
            left_out.append(index)
            continue
        lines.append(_write_frame(out, frame, moving, background, sequence.camera.depth_scale))
        shares.append((float(moving.mean()), float((moving & _unknown(background)).mean())))
        if progress is not None:
            progress(done, len(cleaner.indices))
    _write_lists(out, run, sequence, lines)
    replaced, unknown = np.mean(shares, axis=0)
    return CleanReport(len(lines), tuple(sorted(left_out)), float(replaced), float(unknown))


def _unknown(background: Background) -> NDArray[np.bool_]:
    return ~background.known | (background.depth == 0)


def _write_frame(
    out: Path, frame: Frame, moving: NDArray[np.bool_], background: Background, depth_scale: float
) -> tuple[str, str]:
    """Write the images of a frame; returns the times of colour and depth as text."""
    import cv2

    stamp = f"{frame.timestamp:.6f}"
    color_stamp = stamp if frame.color_timestamp is None else f"{frame.color_timestamp:.6f}"
    units = np.rint(background.depth * depth_scale)
    images = {
        f"rgb/{color_stamp}.png": background.color[..., ::-1],
        f"depth/{stamp}.png": np.where(units > 65535, 0, units).astype(np.uint16),
        f"replaced/{stamp}.png": moving.astype(np.uint8) * 255,
        f"unknown/{stamp}.png": (moving & _unknown(background)).astype(np.uint8) * 255,
    }
    for name, image in images.items():
        write_bytes(out / name, cv2.imencode(".png", image)[1].tobytes(), sync=False)
    return color_stamp, stamp


def _write_lists(out: Path, run: RunContent, sequence: "Sequence", lines: list[tuple[str, str]]) -> None:
    camera = sequence.camera
    lists = {
        "rgb.txt": [f"{color} rgb/{color}.png" for color, _ in lines],
        "associations.txt": [f"{color} rgb/{color}.png {depth} depth/{depth}.png" for color, depth in lines],
        **{f"{name}.txt": [f"{t} {name}/{t}.png" for _, t in lines] for name in ("depth", "replaced", "unknown")},
    }
    for name, rows in lists.items():
        text = "\n".join([f"# {sequence.name} without what moves, by dudmap clean", *rows])
        write_text(out / name, text + "\n")
    keys = ("fx", "fy", "cx", "cy", "width", "height", "depth_scale")
    numbers = [f"{key} {getattr(camera, key)}" for key in keys]
    numbers += [f"{key} {value}" for key, value in zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=False)]
    write_text(out / "intrinsics.txt", "\n".join(numbers) + "\n")
    run.trajectory.save(out / "trajectory.txt")
    if sequence.ground_truth is not None:
        sequence.ground_truth.save(out / "groundtruth.txt")
