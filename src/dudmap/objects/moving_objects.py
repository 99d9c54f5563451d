"""Moving objects of a recording: identity and velocity of all, shape and trajectory of the rigid ones."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.objects.object_fusion import ObjectFusion
from dudmap.objects.object_map import RigidObject
from dudmap.objects.object_tracker import Mover, ObjectTracker
from dudmap.tracking.estimate import PoseEstimate
from dudmap.tracking.frame_view import FrameView


class MovingObjects:
    """Tracks the objects that the labels show to move; nothing here influences the camera's pose or the map.

    Args:
        config: ``movers`` switches tracking and fusion on and off.
    """

    def __init__(self, config: Config) -> None:
        self.tracker = ObjectTracker(config.movers) if config.movers.enabled else None
        self.fusion = ObjectFusion(config) if config.movers.enabled and config.movers.meshes else None

    def update(self, view: FrameView, estimate: PoseEstimate) -> tuple[Mover, ...]:
        """The moving objects of a tracked frame, by id."""
        if self.tracker is None or estimate.labels is None:
            return ()
        level, T_world_camera = view.labelled, estimate.T_world_camera
        with view.timer("movers"):
            movers = tuple(self.tracker.update(view.timestamp, estimate.labels.dynamic, level, T_world_camera))
        if self.fusion is not None:
            with view.timer("bodies"):
                fused = self.fusion.update(view.observation, movers, level, T_world_camera, estimate.exposure)
            movers = tuple(fused)
        return movers

    def rigid_objects(self, Ts_world_camera: Mapping[float, NDArray[np.float64]]) -> list[RigidObject]:
        """Shape and trajectory of the objects so far, given the camera poses (4, 4) by time; empty without fusion."""
        return [] if self.fusion is None else self.fusion.objects(dict(Ts_world_camera))
