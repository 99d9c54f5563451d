"""Store of fused frames on disk, from which maps are rebuilt."""

import weakref
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.backends.cpu import rvl
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import exposed_color
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.se3 import agree
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.scratch_store import ScratchStore
from dudmap.core.state import Remembered, Stateful

DEPTH_UNIT = 0.0005
"""Step of the stored depth, reference depths: 0.14 mm rms in a room, a seventh of ``sigma_base``."""
JPEG_QUALITY = 95
KEEP_ANGLE_DEG = 5.0
"""Rotation since the last stored frame that stores a fused frame, degrees."""
MAX_PENDING = 3
"""Frames that wait for encoding before ``add`` blocks."""
CELLS = 8, 6
"""Cells of an image, across and down, see ``KeptFrame.cells``."""
EncodedFrame = tuple[bytes, bytes, bytes]


@dataclass(frozen=True)
class StoredFrame:
    """A frame as it was fused.

    Attributes:
        static: (H, W) bool, fused pixels.
        T_world_camera: (4, 4).
    """

    frame: Frame
    static: NDArray[np.bool_]
    T_world_camera: NDArray[np.float64]
    count: int


@dataclass(eq=False)
class KeptFrame:
    """A stored frame without its images.

    Attributes:
        timestamp: Seconds.
        T_world_camera: (4, 4), corrected with the map.
        submap: Number of its submap; -1 if discarded.
        cells: Bit mask of the ``CELLS`` in which most pixels were fused.
        color_timestamp: Seconds; None if unknown.
        count: Fused frames that it represents; 0 without images.
    """

    timestamp: float
    T_world_camera: NDArray[np.float64]
    submap: int
    cells: int
    color_timestamp: float | None = None
    count: int = 1


class FrameStore(Stateful):
    """Selected fused frames in a temporary file.

    A frame is stored if the camera has moved by ``distance`` (m) or turned by ``angle_deg`` since the last stored
    frame, if ``gap`` frames were fused since then, or in another submap. Other frames increase the count of the last
    one. A background thread encodes (depth RVL, colour JPEG, mask PNG). Frames are numbered in order of time; without
    images they keep number and pose. Not thread-safe.

    Attributes:
        registered: Registers recorded colour to depth; None for registered colour.
        frames: All frames, by number.
        archived: Reads a frame of a continued run, by number.
    """

    frames: Remembered[list[KeptFrame]]

    def __init__(
        self,
        camera: Camera,
        distance: float = 0.08,
        angle_deg: float = 5.0,
        gap: int = 15,
        registered: Callable[[Frame], Frame] | None = None,
        depth_unit: float = DEPTH_UNIT,
    ) -> None:
        self.camera = camera
        self.registered = registered
        self.depth_unit = depth_unit
        self.distance, self.angle_deg, self.gap = distance, angle_deg, gap
        self.frames = []
        self.archived: Callable[[int], EncodedFrame] | None = None
        self._first_own = 0  # earlier numbers are archived
        self._file: ScratchStore | None = None
        self._encoder: ThreadPoolExecutor | None = None
        self._pending: deque[tuple[int, Future[EncodedFrame]]] = deque()  # with their numbers

    @classmethod
    def of(cls, config: Config, camera: Camera) -> "FrameStore | None":
        """The store for a configuration; None if loops and submaps are off."""
        loops = config.loops
        if not config.relocalization.enabled or not (loops.enabled or config.submaps.enabled):
            return None
        unit = DEPTH_UNIT * config.sensor.reference_depth
        return cls(camera, loops.keep_distance, KEEP_ANGLE_DEG, loops.keep_gap, depth_unit=unit)

    def __len__(self) -> int:
        return len(self.frames)

    def add(
        self,
        frame: Frame,
        static: NDArray[np.bool_],
        T_world_camera: NDArray[np.float64],
        submap: int = 0,
        exposure: tuple[float, float] = (1.0, 0.0),
    ) -> bool:
        """Store a fused frame with its recorded colour, or increase the count of the last one; returns whether it was
        stored.

        The arrays must not change afterwards.

        Raises:
            MapError: The temporary file cannot be written.
        """
        last = self.frames[-1] if self.frames else None
        if last is not None and last.submap == submap and last.count < self.gap:
            if agree(last.T_world_camera, T_world_camera, self.distance, self.angle_deg):
                last.count += 1
                return False
        if self._encoder is None:
            self._encoder = ThreadPoolExecutor(1, thread_name_prefix="dudmap-frames")
            weakref.finalize(self, self._encoder.shutdown, wait=False)
        cells = _fused_cells(frame, static)
        self.frames.append(KeptFrame(frame.timestamp, T_world_camera.copy(), submap, cells, frame.color_timestamp))
        self._pending.append((len(self) - 1, self._encoder.submit(_encoded, frame, static, exposure, self.depth_unit)))
        self._write(MAX_PENDING)
        return True

    @property
    def kept(self) -> list[int]:
        """Numbers of the frames with images."""
        return [number for number, frame in enumerate(self.frames) if frame.count]

    def in_submap(self, submap: int) -> list[int]:
        """Frames of a submap in order of time: the nodes of its pose graph."""
        return [number for number, frame in enumerate(self.frames) if frame.submap == submap]

    def kept_of(self, submap: int) -> list[int]:
        """Frames of a submap with images."""
        return [number for number in self.in_submap(submap) if self.frames[number].count]

    def remove_submap(self, submap: int) -> None:
        """Discard the frames of a submap."""
        for number in self.in_submap(submap):
            self.remove_images(number)
            self.frames[number].submap = -1

    def remove_images(self, number: int) -> None:
        """Remove the images of a frame; its pose stays."""
        if self.frames[number].count == 0:
            return
        if any(number == pending for pending, _ in self._pending):
            self._write(0)
        if self._file is not None and number >= self._first_own:
            self._file.remove(str(number))
        self.frames[number].count = 0

    def __getitem__(self, number: int) -> StoredFrame:
        """The stored frame of a number, which must have images."""
        import cv2

        depth_file, color_file, mask_file = self.encoded(number)
        mask, bgr = (
            np.asarray(cv2.imdecode(np.frombuffer(file, np.uint8), kind))
            for file, kind in ((mask_file, cv2.IMREAD_GRAYSCALE), (color_file, cv2.IMREAD_COLOR))
        )
        steps = rvl.decompressed(depth_file)
        assert steps is not None
        depth = steps.astype(np.float32) * np.float32(self.depth_unit)
        rgb = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)
        kept = self.frames[number]
        frame = Frame(kept.timestamp, depth, rgb, kept.color_timestamp)
        frame = frame if self.registered is None else self.registered(frame)
        return StoredFrame(frame, mask > 0, kept.T_world_camera, kept.count)

    def encoded(self, number: int) -> EncodedFrame:
        """The compressed files of a stored frame."""
        self._write(0)
        if number < self._first_own:
            assert self.archived is not None
            return self.archived(number)
        assert self._file is not None
        depth, color, mask = self._file.read(str(number))
        return depth, color, mask

    def continue_from(self, archived: Callable[[int], EncodedFrame]) -> None:
        """Read the images of the present frames from an archive."""
        self.archived, self._first_own = archived, len(self)

    def __iter__(self) -> Iterator[StoredFrame]:
        return (self[number] for number in self.kept)

    def reintegrate(
        self,
        volume: TsdfVolume,
        numbers: Sequence[int] | None = None,
        Ts_world_camera: Sequence[NDArray[np.float64]] | None = None,
    ) -> None:
        """Fuse stored frames into a map in the given order, each with the weight of its count.

        ``numbers``: None = all with images. ``Ts_world_camera``: (4, 4) each, None = stored.
        """
        for i, number in enumerate(self.kept if numbers is None else numbers):
            stored = self[number]
            T = stored.T_world_camera if Ts_world_camera is None else Ts_world_camera[i]
            volume.integrate(stored.frame, T, stored.static, stored.count)

    def _write(self, max_pending: int) -> None:
        while self._pending and (len(self._pending) > max_pending or self._pending[0][1].done()):
            if self._file is None:
                self._file = ScratchStore("fused frames")
            number, encoded = self._pending.popleft()
            self._file.write(str(number), encoded.result())


def _fused_cells(frame: Frame, static: NDArray[np.bool_]) -> int:
    import cv2

    used = (static & (frame.depth > 0)).astype(np.float32)
    cells = np.asarray(cv2.resize(used, CELLS, interpolation=cv2.INTER_AREA)) > 0.5
    return int(cells.ravel() @ (1 << np.arange(cells.size)))


def _encoded(frame: Frame, static: NDArray[np.bool_], exposure: tuple[float, float], depth_unit: float) -> EncodedFrame:
    """Depth in 16-bit steps of ``depth_unit`` metres (RVL), exposed colour (JPEG), static mask (1-bit PNG)."""
    import cv2

    png = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]  # the fastest
    steps = np.minimum(frame.depth * np.float32(1 / depth_unit) + np.float32(0.5), 65535).astype(np.uint16)
    bgr = cv2.cvtColor(exposed_color(frame.rgb, exposure), cv2.COLOR_RGB2BGR)
    color = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    mask = cv2.imencode(".png", static.astype(np.uint8) * np.uint8(255), [*png, cv2.IMWRITE_PNG_BILEVEL, 1])[1]
    return rvl.compressed(steps), color.tobytes(), mask.tobytes()
