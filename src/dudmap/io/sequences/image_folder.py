"""Recordings of pairs of image files: base class of all folder formats."""

import re
from collections.abc import Iterable, Sized
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.association import TimedFile, associate
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.times import SECONDS
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError, FrameError
from dudmap.io.sequences import Recording, camera_search, images, intrinsics, rotated_depth
from dudmap.io.sequences.pose_matrices import read_matrices, read_matrix, rigid_trajectory
from dudmap.io.sequences.rotated_depth import Rotated

PROBES = 30
OFF_CENTER = 0.08
"""Largest offset of a plausible principal point, share of the image."""
FRAME_RATE = 30.0
"""Assumed frames per second of recordings without times: the rate of most depth cameras."""


class ImageFolder(Recording):
    """Base class of recordings with a colour and a depth file, or a depth file, per frame.

    A format defines its files (``color_files`` and so on) or pairing (``_find_pairs``), and optionally cameras
    (``published``), ground truth (``_find_ground_truth``) and ``_read_depth``.

    Args:
        camera: Replaces the recording's intrinsics: a Camera or ``fx,fy,cx,cy[,w,h[,depth_scale]]``. Colour of another
            size keeps its own camera.

    Raises:
        DatasetError: A file is missing or malformed, no images pair, or no frame is valid.
    """

    options: tuple[str, ...] = ("fps", "depth_unit")
    depth_scale = 1000.0
    """Default depth units per metre."""
    color_files: tuple[str, str] = ("rgb", r"(\d+)\.png")
    depth_files: tuple[str, str] = ("depth", r"(\d+)\.png")
    pose_files: tuple[str, str] | None = None
    """Folder and name pattern of images and camera-to-world matrices."""
    pose_list = ""
    """File with a camera-to-world matrix per frame."""
    published: tuple[str, dict[str, float]] | None = None
    """Name and camera of the data set."""

    def __init__(self, path: str | Path, camera: Camera | str | None = None) -> None:
        super().__init__(path)
        self.name = self.path.resolve().name
        self._pairing, self.image_counts = "a list of pairs", None
        self.rotated, self._unit_remark = Rotated.NO, ""
        self._pairs = self._find_pairs()
        self.timestamps = np.array([depth.timestamp for _, depth in self._pairs], dtype=np.float64)
        known = self._find_intrinsics() if camera is None else self._replaced(camera)
        unit = "depth_scale" in known.values
        self.sources = {
            "intrinsics": known.source,
            "depth unit": known.source if unit else f"assumed, usual in the format {self.format}",
            "times": self._time_source() if self.timed else f"assumed, {FRAME_RATE:g} frames a second",
            "frames": self._pairing,
        }
        self.calibration = known.calibration()
        self.camera = self._probe(known)
        self._look_for_rotation(given=unit and not known.source.endswith(intrinsics.BY_NAME))
        self._take_truth()

    def _look_for_rotation(self, *, given: bool) -> None:
        def read(index: int) -> NDArray[np.float32]:
            return self._read_depth(self._pairs[index][1].path, 1.0)

        self.rotated = rotated_depth.judge(len(self), read, self.camera.depth_scale, given=given)
        if self.rotated is Rotated.YES and not given:
            self.camera = replace(self.camera, depth_scale=rotated_depth.UNITS_PER_METRE)
            self.sources["depth unit"] = "recognised: 16-bit millimetres rotated left by three bits, as in SUN3D"
        self._unit_remark = "" if given and self.rotated is Rotated.YES else self.rotated.value

    def set_depth_unit(self, unit: float) -> None:
        """As for ``Recording``; rotated values need 0.125 mm."""
        super().set_depth_unit(unit)
        self._look_for_rotation(given=True)
        self.rotated, self._unit_remark = self.rotated if self.rotated is Rotated.YES else Rotated.NO, ""
        self._take_truth()

    def _time_source(self) -> str:
        units = {file.unit for pair in self._pairs for file in pair} - {SECONDS}
        taken = f", whose numbers are taken as {' and '.join(sorted(unit.name for unit in units))}" if units else ""
        return f"the recording{taken}"

    def _take_truth(self) -> None:
        try:
            self.ground_truth = self._find_ground_truth()
            said = self.ground_truth.remarks if self.ground_truth is not None else ()
            remarks = [f"ground truth: {remark}" for remark in said]
        except DatasetError as error:
            self.ground_truth, remarks = None, [f"the ground truth is not used: {error}"]
        self.remarks = [*filter(None, [self._unit_remark]), *remarks]

    @property
    def image_files(self) -> list[tuple[Path, Path]]:
        """Colour and depth files of all frames."""
        return [(color.path, depth.path) for color, depth in self._pairs]

    @property
    def color_timestamps(self) -> NDArray[np.float64]:
        """(N,) timestamps of the colour images, seconds."""
        return np.array([color.timestamp for color, _ in self._pairs], dtype=np.float64)

    def _frame(self, index: int, name: str) -> Frame:
        frame = self._read(index, self.camera.depth_scale)
        if self.calibration is None and frame.rgb.shape[:2] != frame.depth.shape:
            raise FrameError(self._unequal(index, frame))
        if frame.depth.shape != self.camera.shape:
            raise FrameError(
                f"frame {index}: {self._pairs[index][1].path} is {size(frame.depth)} pixels, but the recording's "
                f"camera is {self.camera.width}x{self.camera.height}"
            )
        return frame

    def _unequal(self, index: int, frame: Frame) -> str:
        color_file, depth_file = self._pairs[index]
        return (
            f"frame {index}: the colour image {color_file.path} is {size(frame.rgb)} pixels but the depth image "
            f"{depth_file.path} is {size(frame.depth)}; both must have one size, with depth registered to "
            "colour, or intrinsics.txt must give the colour camera (color_fx and so on)"
        )

    def set_rate(self, fps: float) -> None:
        """Replace the assumed rate of numbered frames.

        Raises:
            DatasetError: The recording has its own times.
        """
        if self.timed:
            raise DatasetError(
                f"{self.path} has times of its own, which --fps {fps:g} does not replace; leave --fps out"
            )
        factor = 1.0 / (fps * float(np.median(np.diff(self.timestamps)))) if len(self) > 1 else FRAME_RATE / fps
        self._pairs = [tuple(TimedFile(factor * file.timestamp, file.path) for file in pair) for pair in self._pairs]
        self.timestamps = factor * self.timestamps
        if self.ground_truth is not None:
            truth = self.ground_truth
            self.ground_truth = replace(truth, timestamps=factor * truth.timestamps)
        self.timed, self.sources["times"] = True, f"--fps {fps:g}"

    def _find_pairs(self) -> list[tuple[TimedFile, TimedFile]]:
        return self._pair_numbered(self._numbered(self.color_files), self._numbered(self.depth_files))

    def _numbered(self, files: tuple[str, str]) -> dict[int, Path]:
        folder, pattern = files
        return numbered_files((self.path / folder).iterdir(), pattern)

    def _find_intrinsics(self) -> intrinsics.Intrinsics:
        return camera_search.known(self.path, self._published(), self._sizes)

    def _sizes(self) -> tuple[tuple[int, int], tuple[int, int]] | None:
        for color, depth in self._pairs[:PROBES]:
            try:
                height, width = self._read_depth(depth.path, 1.0).shape
                rows, columns = self._read_color(color.path).shape[:2] if self.has_color else (height, width)
            except FrameError:
                continue
            return (width, height), (columns, rows)
        return None

    def _published(self) -> intrinsics.Intrinsics | None:
        return None if self.published is None else intrinsics.by_name(*self.published)

    def _one_view(self, cameras: list[dict[str, float]], source: str) -> intrinsics.Intrinsics:
        color, depth = (self._read_color(self._pairs[0][0].path), self._read_depth(self._pairs[0][1].path, 1.0))
        (height, width), unit = color.shape[:2], {"depth_scale": self.depth_scale}
        values = {key: float(np.median([camera.get(key, 0.0) for camera in cameras])) for key in cameras[0]}
        values |= {"width": width, "height": height}
        if color.shape[:2] == depth.shape:
            return intrinsics.Intrinsics(values | unit, source)
        view = intrinsics.Intrinsics(values, source).camera(width, height).resized(depth.shape[1], depth.shape[0])
        return intrinsics.Intrinsics(intrinsics.from_camera(view).values | unit, source, values)

    def _find_ground_truth(self) -> Trajectory | None:
        if self.pose_list:
            return self._listed_poses(self.path / self.pose_list)
        poses = self._numbered(self.pose_files) if self.pose_files else {}
        return rigid_trajectory((n / FRAME_RATE, read_matrix(poses[n])) for n in sorted(poses))

    def _listed_poses(self, file: Path) -> Trajectory | None:
        if not file.is_file():
            return None
        return rigid_trajectory((n / FRAME_RATE, T) for n, T in enumerate(read_matrices(file)))

    def _stamped_poses(self) -> Trajectory | None:
        file = self.path / "groundtruth.txt"
        return Trajectory.load(file, optional=True) if file.is_file() else None

    def _pair_numbered(
        self, colors: dict[int, Path], depths: dict[int, Path], per_second: float | None = None
    ) -> list[tuple[TimedFile, TimedFile]]:
        """(colour, depth) files of equal numbers, at number over ``per_second``; None: numbers count frames at
        ``FRAME_RATE``."""
        numbers = sorted(colors.keys() & depths.keys())
        if not numbers:
            raise DatasetError(
                f"{self.path} has {len(colors)} colour and {len(depths)} depth images, but none of them has the same "
                "number"
            )
        self.timed = per_second is not None
        rate = per_second or FRAME_RATE
        self._pairing, self.image_counts = _counted("equal numbers", colors, depths), (len(colors), len(depths))
        return [(TimedFile(n / rate, colors[n]), TimedFile(n / rate, depths[n])) for n in numbers]

    def _alone(self, depths: list[TimedFile]) -> list[tuple[TimedFile, TimedFile]]:
        self.has_color, self._pairing = False, f"{len(depths)} depth images without colour"
        return [(depth, depth) for depth in depths]

    def _pair_timed(self, colors: list[TimedFile], depths: list[TimedFile]) -> list[tuple[TimedFile, TimedFile]]:
        pairs = associate(np.array([c.timestamp for c in colors]), np.array([d.timestamp for d in depths]))
        if not pairs:
            raise DatasetError(
                f"{self.path}: no colour image lies within 20 ms of a depth image; the colour images cover "
                f"{colors[0].timestamp:.3f} to {colors[-1].timestamp:.3f} s and the depth images "
                f"{depths[0].timestamp:.3f} to {depths[-1].timestamp:.3f} s"
            )
        how = "nearest in time, at most 20 ms apart"
        self._pairing, self.image_counts = _counted(how, colors, depths), (len(colors), len(depths))
        return [(colors[i], depths[j]) for i, j in pairs]

    def _read_depth(self, path: Path, depth_scale: float) -> NDArray[np.float32]:
        return images.read_depth(path, depth_scale)

    def _read_color(self, path: Path) -> NDArray[np.uint8]:
        return images.read_color(path)

    def _replaced(self, camera: Camera | str) -> intrinsics.Intrinsics:
        """Given intrinsics, with the recording's colour camera of another size."""
        given = intrinsics.given(camera)
        try:
            own = self._find_intrinsics()
        except DatasetError:  # the user gives intrinsics because the recording lacks them
            return given
        shape = own.color and self._read_depth(self._pairs[0][1].path, 1.0).shape
        if not own.color or (own.color["height"], own.color["width"]) == shape:
            return given
        source = f"{given.source}; colour: {own.source}"
        return intrinsics.Intrinsics(given.values, source, own.color, own.T_depth_color)

    def _read(self, index: int, depth_scale: float) -> Frame:
        color_file, depth_file = self._pairs[index]
        try:
            rotated = self.rotated is Rotated.YES
            depth = self._read_depth(depth_file.path, 1.0 if rotated else depth_scale)
            depth = rotated_depth.metres(depth, depth_scale) if rotated else depth
            color = self._read_color(color_file.path) if self.has_color else None
        except FrameError as error:
            raise FrameError(f"frame {index}: {error}") from error
        if self.calibration is not None and color is not None and color.shape[:2] != self.calibration.camera.shape:
            expected = self.calibration.camera
            raise FrameError(
                f"frame {index}: the colour image {color_file.path} is {size(color)} pixels, but the recording's "
                f"colour camera is {expected.width}x{expected.height}"
            )
        return Frame(depth_file.timestamp, depth, color, color_file.timestamp)

    def _probe(self, known: intrinsics.Intrinsics) -> Camera:
        problem = None
        for index in np.unique(np.linspace(0, len(self) - 1, PROBES).astype(int)):
            try:
                frame = self._read(int(index), known.values.get("depth_scale", self.depth_scale))
            except FrameError as error:
                problem = problem or str(error)
                continue
            if frame.depth.any():
                camera = known.camera(frame.depth.shape[1], frame.depth.shape[0], self.depth_scale)
                if self.calibration is None and frame.rgb.shape[:2] != camera.shape:
                    if not _is_centered(camera):  # the intrinsics may belong to the colour images
                        problem = problem or self._unequal(int(index), frame)
                        continue
                    self.calibration = Calibration(_same_view(camera, *frame.rgb.shape[:2]))
                    self.sources["colour camera"] = "the depth camera, assumed to have its field of view and position"
                return camera
            problem = problem or f"frame {index}: the depth image holds no reading, all its pixels are zero"
        raise DatasetError(f"no frame of {self.path} is usable; {problem}")


def _is_centered(camera: Camera) -> bool:
    middle, size = np.array([camera.cx, camera.cy]) + 0.5, np.array([camera.width, camera.height])
    return bool(np.all(np.abs(middle / size - 0.5) < OFF_CENTER))


def _same_view(camera: Camera, height: int, width: int) -> Camera:
    factor = width / camera.width
    return Camera(factor * camera.fx, factor * camera.fy, (width - 1) / 2, (height - 1) / 2, width, height)


def _counted(how: str, colors: Sized, depths: Sized) -> str:
    return f"{len(colors)} colour and {len(depths)} depth images, {how}"


def size(image: NDArray) -> str:
    """Width and height of an image, for messages."""
    return f"{image.shape[1]}x{image.shape[0]}"


def numbered_files(paths: Iterable[Path], pattern: str) -> dict[int, Path]:
    """Files by the number in the first group of a pattern of the file name."""
    matches = ((re.fullmatch(pattern, path.name), path) for path in paths)
    return {int(match.group(1)): path for match, path in sorted(matches, key=lambda item: item[1].name) if match}
