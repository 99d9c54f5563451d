"""A thing rendered into the frames of a real recording."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.io.sequences import Sequence
from dudmap.lab.synthetic.render import Renderer
from dudmap.lab.synthetic.scene import Light, Primitive, Scene
from dudmap.lab.synthetic.sensors import Sensor


class WithThing:
    """Frames of a recording with inserted solids, hidden by nearer depth only.

    Args:
        trajectory: Poses in the solids' world; others stay unchanged.
        solids: The thing, or none.
    """

    def __init__(self, recording: Sequence, frames: range, trajectory: Trajectory, solids: list[Primitive]) -> None:
        self.name, self.camera, self.calibration = recording.name, recording.camera, recording.calibration
        self.timestamps, self.ground_truth = recording.timestamps[frames.start : frames.stop], None
        self._recording, self._frames, self._sensor = recording, frames, Sensor("kinect", 1)
        self._poses = dict(zip(np.round(trajectory.timestamps, 4), trajectory.Ts_world_camera, strict=True))
        first = trajectory.Ts_world_camera[0] if len(trajectory) else np.eye(4)
        corner, line = (0.0, 0.0, 0.0), ((0.0, 0.0), (0.0, 0.0))
        self._renderer = None if not solids else Renderer(
            Scene(
                "thing", solids, first, corner, (corner, corner), (corner, corner), line, first, first,
                lights=(Light(tuple(first[:3, 3] - first[:3, 1])),),
            ),
            solids,
        )  # fmt: skip
        self.seen: list[NDArray[np.float64]] = []
        """Visible points (n, 3) of the thing in each read frame, metres, solids' world."""

    def __len__(self) -> int:
        return len(self._frames)

    def mask(self, index: int) -> None:
        """There is no true mask."""

    def __getitem__(self, index: int) -> Frame:
        frame = self._recording[self._frames[index]]
        T = self._poses.get(np.round(frame.timestamp, 4))
        if T is None or self._renderer is None:
            return frame
        rendering = self._renderer.render(self.camera, T, np.empty((0, 4, 4)), np.empty(0, bool))
        depth, color = self._sensor.measure(rendering, self.camera.fx, index)
        before = (rendering.depth > 0) & ((frame.depth == 0) | (rendering.depth < frame.depth))
        shown = before & (depth > 0)
        points = self.camera.backproject(np.where(shown, rendering.depth, 0))[shown].astype(np.float64)
        self.seen.append(points @ T[:3, :3].T + T[:3, 3])
        return replace(
            frame, depth=np.where(shown, depth, frame.depth), color=np.where(before[..., None], color, frame.rgb)
        )
