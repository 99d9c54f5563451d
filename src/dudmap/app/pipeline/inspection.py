"""Describe a recording and find faults in it, from its lists and a few frames."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.app.pipeline.image_checks import WRONG, focal_error, image_warnings
from dudmap.config import Config
from dudmap.errors import FrameError
from dudmap.io.sequences import has_color, read_frame
from dudmap.io.sequences.camera_search import FIELD_OF_VIEW, OFF_CENTER, SCALED, UNEQUAL_FOCAL
from dudmap.io.sequences.intrinsics import BY_NAME
from dudmap.io.sequences.rotated_depth import Rotated
from dudmap.ranges import size_of

if TYPE_CHECKING:
    from dudmap.core.frames.frame import Frame
    from dudmap.core.geometry.camera import Camera
    from dudmap.core.geometry.trajectory import Trajectory
    from dudmap.io.sequences import Sequence

DEPTH_ALONE = "there are no colour images: the camera is tracked by distances alone, and the mesh has no colours"
SAMPLES = 12
NEAR, FAR = 0.1, 8.0
"""Median depths, metres, outside of which an assumed unit is doubted."""
LEAST, LARGEST = 0.05, 25.0
"""Median depths, metres, outside of which any unit is doubted: wrist cameras 0.07 m, outdoor stereo 20 to 40 m."""
LEFT_OUT = 0.1
"""Share of measurements outside the depth range that causes a warning."""
NEAREST, FARTHEST = 0.2, 10.0
"""Plausible 5th and 95th percentile of depths, metres, if the median is outside ``SEEN``."""
SEEN = (0.4, 4.0)
"""Median depths, metres, of undoubted scale."""
FEW_READINGS = 0.2
"""Share of pixels with depth below which it is sparse."""
GAP = 3.0
"""Time between frames that is a gap, medians."""
LEFT_OVER = 0.02
"""Share of images without a partner that causes a warning."""
SLOW, FAST = 1.0, 0.001
"""Median frame interval, seconds, outside of which time unit or camera is wrong."""
LATE = 0.015
"""Median time between colour and depth, seconds, that warns: half a frame."""
RUN = 6
TUM_ENDED = 1356998400.0
"""The year 2013, seconds since 1970, after which no recording is TUM RGB-D's."""
SCALES = (1000.0, 5000.0, 1.0, 4000.0, 6553.5, 10000.0)
"""Depth scales, units per metre; the first that fits replaces an implausible one."""
USUAL = (0.4, 8.0)
"""Median depth, metres, of a proposed scale."""


@dataclass
class Inspection:
    """Content of a recording.

    Attributes:
        duration: From the first to the last depth image, seconds.
        rate: Depth images per second (median).
        color_rate: Colour images per second, or None.
        gaps: (time of the frame before, length), seconds.
        camera, color_camera: Depth and colour camera; equal for registered images.
        T_color_depth: 4x4, row by row; None for registered images.
        sources: Origin of intrinsics, depth unit and times.
        depth_scale: 16-bit units per metre.
        median_depth: Of the sampled frames, metres, or None.
        valid_depth: Share of pixels with depth.
        depth_range, voxel_size: Given or chosen, metres.
        too_near, too_far: Shares below and above ``depth_range``.
        ground_truth: Number of ground truth poses, 0 without.
        repeats: Shares of frames that repeat the previous ``frame``, ``depth`` or ``color``; empty if not compared.
    """

    name: str
    format: str
    frames: int
    duration: float
    rate: float | None
    color_rate: float | None
    gaps: list[tuple[float, float]]
    camera: dict[str, Any]
    color_camera: dict[str, Any]
    T_color_depth: list[list[float]] | None
    sources: dict[str, str]
    depth_scale: float
    median_depth: float | None
    valid_depth: float
    depth_range: tuple[float, float]
    voxel_size: float
    too_near: float
    too_far: float
    ground_truth: int
    has_color: bool = True
    unreadable: list[str] = field(default_factory=list)
    repeats: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def distinct_rate(self, stream: str) -> float | None:
        """Distinct images per second of ``depth`` or ``color``; None if unknown."""
        if self.rate is None or not self.repeats:
            return None
        return self.rate * (1 - self.repeats["frame"] - self.repeats[stream])


def sample(sequence: "Sequence", count: int = SAMPLES) -> "tuple[list[tuple[int, Frame]], list[str]]":
    """Numbers and frames of an even selection, and errors of unreadable ones."""
    frames, unreadable = [], []
    for index in np.unique(np.linspace(0, len(sequence) - 1, count).astype(int)):
        try:
            frames.append((int(index), read_frame(sequence, int(index))))
        except FrameError as error:
            unreadable.append(str(error))
    return frames, unreadable


def repeats(sequence: "Sequence") -> dict[str, float]:
    """Shares of RUN consecutive frames at SAMPLES places identical to the previous one: ``frame``, ``depth`` or
    ``color``; empty if unreadable."""
    from dudmap.core.frames.stream_check import repeated

    counts, pairs = {"frame": 0, "depth": 0, "color": 0}, 0
    last = max(0, len(sequence) - RUN)
    for start in np.unique(np.linspace(0, last, SAMPLES).astype(int)):
        before = None
        for index in range(start, min(start + RUN, len(sequence))):
            try:
                frame = read_frame(sequence, index)
            except FrameError:
                before = None
                continue
            if before is not None:
                pairs += 1
                kind = repeated((before.depth, before.color), (frame.depth, frame.color))
                if kind:
                    counts[kind] += 1
            before = frame
    return {kind: count / pairs for kind, count in counts.items()} if pairs else {}


def inspect(
    sequence: "Sequence",
    frames: "list[tuple[int, Frame]] | None" = None,
    unreadable: list[str] | None = None,
    config: Config | None = None,
) -> Inspection:
    """Describe a recording and its suspected faults.

    ``frames``, ``unreadable``: results of ``sample``. ``config`` gives the depth range; None chooses it as ``dudmap
    run`` does.
    """
    if frames is None:
        frames, unreadable = sample(sequence)
    if config is None:
        config = Config.from_tree({}, size_of(frame.depth for _, frame in frames))
    least, largest = config.depth_limits
    depths = [frame.depth[frame.depth > 0] for _, frame in frames]
    readings = np.concatenate(depths) if depths else np.zeros(0, np.float32)
    pixels = sum(frame.depth.size for _, frame in frames)
    camera, calibration = sequence.camera, sequence.calibration
    colored = (has_color(sequence) and any(frame.color is not None for _, frame in frames)) or not frames
    colors = getattr(sequence, "color_timestamps", None) if colored else None
    truth = sequence.ground_truth
    found = Inspection(
        name=sequence.name,
        format=getattr(sequence, "format", type(sequence).__name__),
        frames=len(sequence),
        duration=float(sequence.timestamps[-1] - sequence.timestamps[0]),
        rate=_rate(sequence.timestamps),
        color_rate=None if colors is None else _rate(np.unique(colors)),
        gaps=_gaps(sequence.timestamps),
        camera=_numbers(camera),
        color_camera=_numbers(camera if calibration is None else calibration.camera),
        T_color_depth=None if calibration is None else calibration.T_color_depth.tolist(),
        sources=dict(getattr(sequence, "sources", {})),
        depth_scale=camera.depth_scale,
        median_depth=float(np.median(readings)) if len(readings) else None,
        valid_depth=len(readings) / pixels if pixels else 0.0,
        depth_range=(least, largest),
        voxel_size=config.volume.voxel_size,
        too_near=float(np.mean(readings < least)) if len(readings) else 0.0,
        too_far=float(np.mean(readings > largest)) if len(readings) else 0.0,
        ground_truth=0 if truth is None else len(truth),
        has_color=colored,
        unreadable=list(unreadable or []),
    )
    found.warnings = [
        *_focal_warnings(sequence, found.sources),
        *([] if colored else [DEPTH_ALONE]),
        *_depth_warnings(found, readings, _unit_is_open(sequence)),
        *image_warnings([frame for _, frame in frames]),
        *_camera_warnings("depth camera", camera),
        *([] if calibration is None else _camera_warnings("colour camera", calibration.camera)),
        *_time_warnings(sequence.timestamps, colors),
        *_truth_warnings(sequence.timestamps, truth),
        *_pairing_warnings(sequence, found.sources),
        *getattr(sequence, "remarks", ()),
    ]
    return found


def _unit_is_open(sequence: "Sequence") -> bool:
    rotated = getattr(sequence, "rotated", Rotated.NO)
    return "depth_unit" in getattr(sequence, "options", ("depth_unit",)) and rotated is Rotated.NO


def _numbers(camera: "Camera") -> dict[str, Any]:
    out = asdict(camera) | {"distortion": list(camera.distortion)}
    del out["depth_scale"]
    return out


def _rate(times: NDArray[np.float64]) -> float | None:
    return float(1.0 / np.median(np.diff(times))) if len(times) > 1 else None


def _gaps(times: NDArray[np.float64]) -> list[tuple[float, float]]:
    steps = np.diff(times)
    limit = GAP * np.median(steps) if len(steps) else 0.0
    return [(float(times[k]), float(steps[k])) for k in np.flatnonzero(steps > limit)]


def _depth_warnings(found: Inspection, readings: NDArray[np.float32], unit_is_open: bool) -> Iterator[str]:
    if found.unreadable:
        yield f"{len(found.unreadable)} of {SAMPLES} sampled frames cannot be read; the first: {found.unreadable[0]}"
    if found.median_depth is None:
        yield "the sampled frames hold no depth reading"
        return
    median, (near, far) = found.median_depth, np.percentile(readings, (5, 95))
    unlikely = (median < SEEN[0] and near < NEAREST) or (median > SEEN[1] and far > FARTHEST)
    units = median * found.depth_scale
    fitting = [scale for scale in SCALES if USUAL[0] <= units / scale <= USUAL[1] and scale != found.depth_scale]
    source = found.sources.get("depth unit", "")
    assumed = not source or source.startswith("assumed") or source.endswith(BY_NAME)
    doubted = assumed and bool(fitting) and (unlikely or not NEAR <= median <= FAR)
    impossible = not LEAST <= median <= LARGEST
    if impossible and not unit_is_open:
        yield f"nine tenths of the readings lie from {near:.2g} to {far:.2g} m, which depth cameras hardly measure"
    elif impossible or (doubted and unit_is_open):
        proposal = f"; {' or '.join(f'{scale:g}' for scale in sorted(fitting))} would be plausible" if fitting else ""
        unit = f"{1 / fitting[0]:.4g}, which is {fitting[0]:g} per metre" if fitting else "METRES"
        yield (
            f"the depth scale looks wrong: with {found.depth_scale:g} units per metre nine tenths of the readings lie "
            f"from {near:.2g} to {far:.2g} m, and the median depth is {median:.3g} m{proposal}: "
            f"give --depth-unit {unit}"
        )
    elif found.too_near + found.too_far > LEFT_OUT:
        yield _left_out(found, readings)
    if found.valid_depth < FEW_READINGS:
        yield f"only {found.valid_depth:.0%} of the pixels have a depth reading"


def _left_out(found: Inspection, readings: NDArray[np.float32]) -> str:
    least, largest = found.depth_range
    if found.too_near > found.too_far:
        share, where = found.too_near, f"nearer than {least:g} m"
        mend = f"depth_min={np.floor(100 * np.percentile(readings, 1)) / 100:g}"
    else:
        share, where = found.too_far, f"farther than {largest:g} m"
        mend = f"depth_max={np.ceil(np.percentile(readings, 99)):g}"
    return f"{share:.0%} of the readings are {where} and are not used; --set preprocess.{mend} takes them in"


def _camera_warnings(name: str, camera: "Camera") -> Iterator[str]:
    problems, sizes = [], np.array([camera.width, camera.height])
    angles = np.degrees(2 * np.arctan(sizes / 2 / [camera.fx, camera.fy]))
    if angles.min() < FIELD_OF_VIEW[0] or angles.max() > FIELD_OF_VIEW[1]:
        problems.append(f"a field of view of {angles[0]:.0f} x {angles[1]:.0f} degrees")
    for axis, center, size in (("x", camera.cx, camera.width), ("y", camera.cy, camera.height)):
        if abs(center + 0.5 - size / 2) > OFF_CENTER * size:
            problems.append(f"a principal point c{axis} of {center:g} in an image of {size} pixels")
    if abs(camera.fx - camera.fy) > UNEQUAL_FOCAL * max(camera.fx, camera.fy):
        problems.append(f"focal lengths of {camera.fx:g} and {camera.fy:g}")
    for problem in problems:
        yield f"the intrinsics of the {name} look wrong: {problem}; give the right ones with --camera"


def _time_warnings(times: NDArray[np.float64], colors: NDArray[np.float64] | None) -> Iterator[str]:
    step = float(np.median(np.diff(times))) if len(times) > 1 else None
    if step is not None and not FAST <= step <= SLOW:
        yield f"the times look wrong: {step:.3g} s from frame to frame; expected seconds, of one camera"
    if colors is None:
        return
    late = float(np.median(np.abs(colors - times)))
    if late > LATE:
        yield f"colour and depth are {1000 * late:.0f} ms apart in most frames: the lists may be paired wrongly"
    if np.any(np.diff(colors) < 0):
        yield "the colour images are not in the order of the depth images: the times of the lists are mixed up"


def _focal_warnings(sequence: "Sequence", sources: dict[str, str]) -> Iterator[str]:
    intrinsics = sources.get("intrinsics", "")
    if SCALED in intrinsics:
        yield f"the camera is taken from {intrinsics}; if the images are cut out of larger ones, give --camera"
    if not intrinsics.endswith(BY_NAME) or sequence.calibration is not None:
        return
    if "TUM" in intrinsics and sequence.timestamps[0] > TUM_ENDED:
        yield (
            f"the camera is {intrinsics}, but the images were taken after that data set: give --camera, or an "
            "intrinsics.txt"
        )
    error, fx = focal_error(sequence), sequence.camera.fx
    if error is not None and abs(error - 1) >= WRONG:
        yield (
            f"the focal length {fx:g} is that of {intrinsics}, but pairs of frames are consistent with about "
            f"{fx / error:.0f}; give the right intrinsics with --camera"
        )


def _pairing_warnings(sequence: "Sequence", sources: dict[str, str]) -> Iterator[str]:
    counts = getattr(sequence, "image_counts", None)
    if counts is not None and len(sequence) < (1 - LEFT_OVER) * max(counts):
        yield f"only {len(sequence)} frames come of {sources['frames']}; the other images are not used"


def _truth_warnings(times: NDArray[np.float64], truth: "Trajectory | None") -> Iterator[str]:
    if truth is not None and not (truth.timestamps[0] <= times[-1] and times[0] <= truth.timestamps[-1]):
        yield (
            f"the ground truth ({truth.timestamps[0]:.3f} to {truth.timestamps[-1]:.3f} s) is of another time than the "
            f"images ({times[0]:.3f} to {times[-1]:.3f} s)"
        )
