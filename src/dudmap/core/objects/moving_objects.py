"""Moving objects of a recording: identity, velocity, and shape of rigid ones."""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.frames.observation import Level
from dudmap.core.objects.object_fusion import ObjectFusion
from dudmap.core.objects.object_map import RigidObject
from dudmap.core.objects.object_tracker import Mover, ObjectTracker
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.frame_view import FrameView, PoseEstimate

MOST_WAITING = 30
"""Frames whose moving objects wait: 0.2 MB each."""


@dataclass(eq=False)
class _Frame:
    timestamp: float
    dynamic: NDArray[np.bool_]
    level: Level
    T_world_camera: NDArray[np.float64]
    movers: tuple[Mover, ...] | None = None


class MovingObjects(Stateful):
    """Tracks moving objects, without influence on pose or map; ``movers`` of the configuration switches it."""

    tracker: Remembered[ObjectTracker | None]
    fusion: Remembered[ObjectFusion | None]
    _waiting: Remembered[deque[_Frame]]

    def __init__(self, config: Config) -> None:
        self.tracker = ObjectTracker(config.movers, config.sensor.reference_depth) if config.movers.enabled else None
        self.fusion = ObjectFusion(config) if config.movers.enabled and config.movers.meshes else None
        self._waiting = deque()
        self._finding = Lock()

    def update(self, view: FrameView, estimate: PoseEstimate) -> Callable[[], tuple[Mover, ...]]:
        """Record a tracked frame; the returned function computes its moving objects, sorted by id, in any thread,

        after earlier frames, of which at most ``MOST_WAITING`` wait. With fusion, objects are computed at once.
        """
        if self.tracker is None or estimate.labels is None:
            return tuple
        level, T_world_camera = view.labelled, estimate.T_world_camera
        level = Level(level.camera, level.depth, level.intensity)  # without the images it is made from
        frame = _Frame(view.timestamp, estimate.labels.dynamic, level, T_world_camera)
        self._waiting.append(frame)
        if self.fusion is not None:
            with view.timer("bodies"):
                fused = self.fusion.update(
                    view.colored(), self._movers(frame), level, T_world_camera, estimate.exposure
                )
            frame.movers = tuple(fused)
        elif len(self._waiting) > MOST_WAITING:
            with self._finding:
                self._waiting.popleft().movers = ()
        return partial(self._movers, frame)

    def _movers(self, frame: "_Frame") -> tuple[Mover, ...]:
        assert self.tracker is not None
        with self._finding:
            while frame.movers is None:
                first = self._waiting.popleft()
                found = self.tracker.update(first.timestamp, first.dynamic, first.level, first.T_world_camera)
                first.movers = tuple(found)
        return frame.movers

    def rigid_objects(self, Ts_world_camera: Mapping[float, NDArray[np.float64]]) -> list[RigidObject]:
        """Shape and trajectory of objects so far, by camera poses (4, 4) by time; empty without fusion."""
        return [] if self.fusion is None else self.fusion.objects(dict(Ts_world_camera))
