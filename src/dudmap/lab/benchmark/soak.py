"""A long run in one room: growth of time, memory and error."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from dudmap.app.pipeline.frame_source import FrameRead
from dudmap.app.pipeline.observer import RunObserver
from dudmap.app.pipeline.run import run
from dudmap.app.pipeline.storing import Storing
from dudmap.config import Config
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.map.memory_limit import resident_bytes
from dudmap.core.result import FrameResult
from dudmap.core.slam import Slam
from dudmap.io.sequences import Sequence
from dudmap.lab.benchmark.measure import Row
from dudmap.lab.benchmark.suites import Entry

FPS = 15.0
"""Frame rate of the recording, Hz."""
MORE = 1.1
"""Largest growth of time and memory, second tenth to last."""


class Rendered:
    """Recording that sums rendering time."""

    def __init__(self, recording: Sequence) -> None:
        self._recording, self.rendered = recording, 0.0

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        return getattr(self._recording, name)

    def __len__(self) -> int:
        return len(self._recording)

    def __getitem__(self, index: int) -> Frame:
        frame = self._recording[index]
        self.rendered = time.process_time()
        return frame


class Tenths(RunObserver):
    """Metrics of each tenth of a run."""

    def __init__(self, recording: Rendered, done: Callable[[Row], None]) -> None:
        self.rows: list[Row] = []
        self._recording, self._done, self._lost = recording, done, 0
        self._times: list[tuple[float, float]] = []
        self._errors: list[float] = []
        self._T_room_world: NDArray[np.float64] | None = None

    def start(self, slam: Slam, out: Path, count: int | None) -> None:  # noqa: D102
        self._slam, self._out = slam, out

    def frame(self, index: int, read: FrameRead, result: FrameResult, ms: float) -> None:  # noqa: D102
        self._times.append((1000 * (time.process_time() - self._recording.rendered), ms))
        if result.T_world_camera is None:
            self._lost += 1
        else:
            true = self._recording.ground_truth.Ts_world_camera[index]
            if (T_room_world := self._T_room_world) is None:
                self._T_room_world = T_room_world = true @ se3.inverse(result.T_world_camera)
            self._errors.append(float(np.linalg.norm((T_room_world @ result.T_world_camera - true)[:3, 3])))
        if (index + 1) % (len(self._recording) // 10) == 0:
            cpu, wall = np.median(self._times, axis=0)
            size = sum(file.stat().st_size for file in self._out.rglob("*") if file.is_file())
            row = {"frames": index + 1, "cpu_ms": float(cpu), "ms": float(wall), "memory_mb": resident_bytes() / 1e6,
                   "blocks": self._slam.live_volume.num_blocks, "folder_mb": size / 1e6, "lost": self._lost,
                   "error_mm": 1000 * max(self._errors, default=float("nan"))}  # fmt: skip
            self.rows.append(row)
            self._done(row)
            self._times, self._errors = [], []


def measure_soak(frames: int, size: tuple[int, int], seed: int, done: Callable[[Row], None]) -> list[Row]:
    """Process a room with people at 15 Hz; the camera swings once in 20 s, noise never repeats.

    Returns:
        Per tenth: processor time and time per frame (medians), memory, map blocks, run folder's size, lost frames,
            largest pose error; ``done`` receives each row.
    """
    world = {"movers": ("people",), "camera_path": "orbit", "frames": frames, "fps": FPS, "seed": seed, "camera": size}
    recording = Rendered(Entry("room-people", parameters=world).open())
    tenths = Tenths(recording, done)
    with tempfile.TemporaryDirectory() as folder:
        out, source = Path(folder) / "run", cast("Sequence", recording)
        run(source, Config(), out, progress=False, ahead=0, observers=(tenths,), storing=Storing({"path": "soak"}))
    return tenths.rows


def grown(rows: list[Row]) -> list[str]:
    """Grown quantities: time or memory by 10 %, error by half a voxel."""
    early, late = rows[1], rows[-1]
    found = [f"{key} {late[key] / early[key]:.2f} times" for key in ("cpu_ms", "memory_mb")
             if late[key] > MORE * early[key]]  # fmt: skip
    if late["error_mm"] > early["error_mm"] + 500 * Config().volume.voxel_size:
        found.append(f"error {early['error_mm']:.1f} to {late['error_mm']:.1f} mm")
    return found
