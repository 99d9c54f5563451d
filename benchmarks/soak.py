"""A day in short: many frames of one room, round the same path, with people, stored as they come.

    python benchmarks/soak.py --frames 20000                # make soak

The camera goes to and fro on an arc around the middle of the room, once in 20 s, while people cross; the noise never
repeats. For each tenth the table has the processor time and the time per frame, the memory of the process, the blocks
of the map, the size of the run folder, and the largest error of a pose since the last row, after the motion that makes
the first pose right. It fails if the last tenth takes 10 % more processor time than the second, if memory grows by more
than 10 % between them, or if the error does by more than half a voxel.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from dudmap.app.pipeline.environment import machine
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
from dudmap.evaluation.trajectory import accuracy
from dudmap.lab import synthetic
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA, SyntheticSequence

MORE = 1.1
"""Largest growth of time and memory from the second tenth to the last."""


class Rendered:
    """A recording that notes the processor time at which a frame is rendered, which is not the system's."""

    def __init__(self, recording: SyntheticSequence) -> None:
        self._recording, self.rendered = recording, 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recording, name)

    def __len__(self) -> int:
        return len(self._recording)

    def __getitem__(self, index: int) -> Frame:
        frame = self._recording[index]
        self.rendered = time.process_time()
        return frame


class Table(RunObserver):
    """Prints a line for each tenth of the run.

    Attributes:
        rows: Processor time per frame in ms, memory in bytes and largest error in metres of each tenth.
        lost: Frames without a pose.
    """

    def __init__(self, recording: Rendered) -> None:
        self.rows: list[tuple[float, float, float]] = []
        self.lost = 0
        self._recording, self._tenth = recording, len(recording) // 10
        self._times: list[tuple[float, float]] = []
        self._errors: list[float] = []
        self._T_room_world: np.ndarray | None = None

    def start(self, slam: Slam, out: Path, count: int | None) -> None:  # noqa: D102
        self._slam, self._out = slam, out
        print("| frames | processor ms per frame, median | ms | memory MB | blocks | folder MB | lost | error mm |")
        print("|---|---|---|---|---|---|---|---|")

    def frame(self, index: int, read: FrameRead, result: FrameResult, ms: float) -> None:  # noqa: D102
        self._times.append((1000 * (time.process_time() - self._recording.rendered), ms))
        if result.T_world_camera is None:
            self.lost += 1
        else:
            true = self._recording.ground_truth.Ts_world_camera[index]
            if self._T_room_world is None:
                self._T_room_world = true @ se3.inverse(result.T_world_camera)
            self._errors.append(np.linalg.norm((self._T_room_world @ result.T_world_camera - true)[:3, 3]))
        if (index + 1) % self._tenth == 0:
            self._row(index + 1)

    def _row(self, frames: int) -> None:
        cpu, ms = np.median(self._times, axis=0)
        row = float(cpu), float(resident_bytes()), float(max(self._errors, default=np.nan))
        self.rows.append(row)
        size = sum(file.stat().st_size for file in self._out.rglob("*") if file.is_file())
        blocks = self._slam.atlas.volume.num_blocks
        print(f"| {frames} | {cpu:.1f} | {ms:.1f} | {row[1] / 1e6:.0f} | {blocks} | {size / 1e6:.0f} | {self.lost} | "
              f"{1000 * row[2]:.1f} |", flush=True)  # fmt: skip
        self._times, self._errors = [], []


def main() -> int:
    """Process the recording, print the table, and say whether anything grew."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--fps", type=float, default=15.0)
    parser.add_argument("--size", default="320x240")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    width, height = (int(number) for number in options.size.split("x"))
    rendered = synthetic.sequence(
        "room", movers=("people",), camera_path="orbit", frames=options.frames, fps=options.fps, seed=options.seed,
        camera=DEFAULT_CAMERA.resized(width, height),
    )  # fmt: skip
    recording = Rendered(rendered)
    print(f"{options.frames} frames of {options.size}, {options.frames / options.fps / 60:.0f} min at {options.fps:g} "
          f"Hz; {machine()['cpu']}, {time.strftime('%Y-%m-%d')}")  # fmt: skip
    table, config = Table(recording), Config()
    with tempfile.TemporaryDirectory() as folder:
        report = run(
            recording, config, Path(folder) / "run", progress=False, ahead=0, observers=(table,),
            storing=Storing({"path": "soak"}),
        )  # fmt: skip
    found = accuracy(report.trajectory, rendered.ground_truth)
    print(f"\nATE {1000 * found['ate_rmse_m']:.1f} mm, {table.lost} frames lost")
    (ms, memory, error), (last_ms, last_memory, last_error) = table.rows[1], table.rows[-1]
    print(f"last tenth over second: processor time {last_ms / ms:.2f}, memory {last_memory / memory:.2f}; "
          f"error {1000 * error:.1f} mm, then {1000 * last_error:.1f} mm")  # fmt: skip
    grown = last_ms > MORE * ms or last_memory > MORE * memory
    return int(grown or last_error > error + config.volume.voxel_size / 2)


if __name__ == "__main__":
    sys.exit(main())
