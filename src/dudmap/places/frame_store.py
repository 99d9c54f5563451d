"""What was fused, kept on disk, so that the map can be built again from better poses or with better masks."""

import tempfile
import weakref
import zlib
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import IO

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import MapError
from dudmap.frames.frame import Frame
from dudmap.geometry import se3
from dudmap.geometry.camera import Camera
from dudmap.mapping.volume import TsdfVolume

DEPTH_UNIT = 0.0005
"""Step of the stored depth, metres; its error, 0.14 mm, is a tenth of the best sensor's noise."""
JPEG_QUALITY = 95
PENDING = 3
"""Frames that may wait for the thread that packs them."""


@dataclass(frozen=True)
class StoredFrame:
    """A frame as it was fused.

    Attributes:
        frame: Depth (0.5 mm steps), and colour (JPEG) with the exposure of the map.
        static: (H, W) bool, what was fused of it.
        T_world_camera: (4, 4).
        count: Fused frames that it stands for.
    """

    frame: Frame
    static: NDArray[np.bool_]
    T_world_camera: NDArray[np.float64]
    count: int


class FrameStore:
    """The fused frames, thinned, in a temporary file that the system removes: memory grows by some hundred bytes each.

    A frame is kept where the camera has moved or turned since the last one kept, or after a number of frames; the
    others count towards the one before them. Packing (zlib on the differences of neighbours, JPEG: about 0.2 MB at
    640x480) runs in a thread of its own. Not for concurrent calls.

    Args:
        camera: Camera of the frames.
        distance: A frame this far from the last kept one is kept, metres,
        angle_deg: or turned by this, degrees,
        gap: or this many fused frames later. 1 keeps all.
    """

    def __init__(self, camera: Camera, distance: float = 0.08, angle_deg: float = 5.0, gap: int = 15) -> None:
        self.camera = camera
        self.distance, self.angle_deg, self.gap = distance, angle_deg, gap
        self.timestamps: list[float] = []
        self.Ts_world_camera: list[NDArray[np.float64]] = []
        self.counts: list[int] = []
        self.submaps: list[int] = []
        self._places: list[tuple[int, int, int, int]] = []  # start in the file; bytes of depth, colour, mask
        self._file: IO[bytes] | None = None
        self._packer: ThreadPoolExecutor | None = None
        self._pending: deque[Future[tuple[bytes, bytes, bytes]]] = deque()

    def __len__(self) -> int:
        return len(self.timestamps)

    def add(
        self, frame: Frame, static: NDArray[np.bool_], T_world_camera: NDArray[np.float64], submap: int = 0
    ) -> bool:
        """Keep a frame that was fused, or count it towards the last one; its arrays must not change afterwards.

        Args:
            frame: Depth and colour as they were fused.
            static: (H, W) bool, pixels that were fused; the others are kept too, for better masks.
            T_world_camera: (4, 4).
            submap: Number of the map it was fused into.

        Returns:
            Whether it was kept.
        """
        if self.timestamps and self.submaps[-1] == submap and self.counts[-1] < self.gap:
            moved = se3.inverse(self.Ts_world_camera[-1]) @ T_world_camera
            if np.linalg.norm(moved[:3, 3]) < self.distance and np.degrees(se3.rotation_angle(moved)) < self.angle_deg:
                self.counts[-1] += 1
                return False
        if self._packer is None:
            self._packer = ThreadPoolExecutor(1, thread_name_prefix="dudmap-history")
            weakref.finalize(self, self._packer.shutdown, wait=False)
        self.timestamps.append(frame.timestamp)
        self.Ts_world_camera.append(T_world_camera.copy())
        self.counts.append(1)
        self.submaps.append(submap)
        self._pending.append(self._packer.submit(_packed, frame, static))
        self._write(PENDING)
        return True

    def drop_last(self) -> None:
        """Forget the frame kept last."""
        self._write(0)
        for column in (self.timestamps, self.Ts_world_camera, self.counts, self.submaps, self._places):
            column.pop()

    def __getitem__(self, number: int) -> StoredFrame:
        """The frame of a number, 0 the oldest."""
        import cv2

        self._write(0)
        assert self._file is not None
        start, *sizes = self._places[number]
        self._file.seek(start)
        depth, color, mask = (self._file.read(size) for size in sizes)
        shape = self.camera.shape
        bgr = cv2.imdecode(np.frombuffer(color, np.uint8), cv2.IMREAD_COLOR)
        assert bgr is not None  # it was encoded here
        rgb = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)
        frame = Frame(self.timestamps[number], _unpacked_depth(depth, shape), rgb)
        bits = np.frombuffer(zlib.decompress(mask), np.uint8)
        static = np.unpackbits(bits, count=shape[0] * shape[1]).reshape(shape).astype(bool)
        return StoredFrame(frame, static, self.Ts_world_camera[number], self.counts[number])

    def __iter__(self) -> Iterator[StoredFrame]:
        return (self[number] for number in range(len(self)))

    def reintegrate(
        self,
        volume: TsdfVolume,
        numbers: Sequence[int] | None = None,
        Ts_world_camera: Sequence[NDArray[np.float64]] | None = None,
        static_masks: Sequence[NDArray[np.bool_] | None] | None = None,
    ) -> None:
        """Fuse kept frames into a map, each with the weight of those it stands for.

        Args:
            volume: The map, usually an empty one.
            numbers: The frames, in this order; None = all.
            Ts_world_camera: Their poses; None = as they are known here.
            static_masks: (H, W) bool each, what is fused of them; None = what was fused before.
        """
        for place, number in enumerate(range(len(self)) if numbers is None else numbers):
            stored = self[number]
            T = stored.T_world_camera if Ts_world_camera is None else Ts_world_camera[place]
            static = None if static_masks is None else static_masks[place]
            volume.integrate(stored.frame, T, stored.static if static is None else static, count=stored.count)

    def _write(self, may_wait: int) -> None:
        """Bring packed frames to the file until at most so many are left."""
        while self._pending and (len(self._pending) > may_wait or self._pending[0].done()):
            parts = self._pending.popleft().result()
            try:
                if self._file is None:
                    self._file = tempfile.TemporaryFile(prefix="dudmap-")
                    weakref.finalize(self, self._file.close)
                start = self._file.seek(0, 2)
                for part in parts:
                    self._file.write(part)
            except OSError as error:
                raise MapError(
                    f"fused frames cannot be kept in {tempfile.gettempdir()}: {error}; make room there, name another "
                    "folder in the environment variable TMPDIR, or switch off loops.enabled and submaps.enabled"
                ) from error
            self._places.append((start, len(parts[0]), len(parts[1]), len(parts[2])))


def _packed(frame: Frame, static: NDArray[np.bool_]) -> tuple[bytes, bytes, bytes]:
    import cv2

    steps = np.minimum(frame.depth * np.float32(1 / DEPTH_UNIT) + np.float32(0.5), 65535).astype(np.uint16).reshape(-1)
    differences = steps.copy()
    differences[1:] -= steps[:-1]  # modulo 2^16
    depth = zlib.compress(differences.view(np.uint8).reshape(-1, 2).T.tobytes(), 1)
    bgr = cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR)
    color = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    return depth, color, zlib.compress(np.packbits(static).tobytes(), 1)


def _unpacked_depth(data: bytes, shape: tuple[int, int]) -> NDArray[np.float32]:
    low_high = np.frombuffer(zlib.decompress(data), np.uint8).reshape(2, -1)
    differences = np.ascontiguousarray(low_high.T).view(np.uint16).reshape(-1)
    steps = np.cumsum(differences, dtype=np.uint16)
    return (steps.astype(np.float32) * np.float32(DEPTH_UNIT)).reshape(shape)
