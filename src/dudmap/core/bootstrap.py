"""The start of a map: its first frame, and the frames held back until it is known what moves in them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.core.dynamics.dominant_motion import exceeds_noise_share
from dudmap.core.dynamics.ego_motion import OlderImage
from dudmap.core.dynamics.masks import full_size
from dudmap.core.frames.pyramid import reduced
from dudmap.core.tracking.estimate import PoseEstimate
from dudmap.core.tracking.frame_view import FrameView

WINDOW, WINDOW_STEP = 30, 2
"""Fused frames after which the poses of a new map are estimated once more, of every second one."""
MIN_READINGS = 0.02
"""Share of the pixels of a first frame that must have a static depth reading."""


@dataclass(frozen=True, eq=False)
class StartFrame:
    """A frame of the first moments of a map.

    Attributes:
        view: The frame.
        estimate: Its pose and labels.
        dynamic_mask: (H, W) bool, pixels that are not fused.
        fused: Whether it is part of the map.
    """

    view: FrameView
    estimate: PoseEstimate
    dynamic_mask: NDArray[np.bool_]
    fused: bool


class Bootstrap:
    """Knows the first frames of a map, and what of them must be taken back.

    A single image does not tell what moves, so everything in the first frame is taken as static that the caller does
    not declare dynamic, and motion that is slow shows only after a while. What moved is taken out of the first frame as
    soon as it shows, and the map begins anew with it. The frames since then are fused once slow motion can be seen,
    without what is seen from there to have moved in them.

    The first frames were registered to a map that had seen little: they are remembered to be registered once more.

    Attributes:
        textureless: Whether the image of the first frame carries no information: later ones are then not called blind.
    """

    def __init__(self) -> None:
        self.textureless = False
        self._frames: list[StartFrame] = []
        self._window: list[StartFrame] = []
        self._num_fused = 0

    @staticmethod
    def rejection_reason(view: FrameView, dynamic_mask: NDArray[np.bool_]) -> str:
        """Sentence on why a frame cannot start a map, empty if it can."""
        depth = view.observation.depth
        enough = np.count_nonzero(depth[~dynamic_mask]) >= MIN_READINGS * depth.size
        return "" if enough else "the depth image holds hardly any readings"

    def start(self, view: FrameView, dynamic_mask: NDArray[np.bool_]) -> None:
        """Remember the frame that a map was made of."""
        first = StartFrame(view, PoseEstimate.at_origin(), dynamic_mask, fused=True)
        self._frames, self._window, self._num_fused = [first], [first], 1

    def fused(self, view: FrameView, estimate: PoseEstimate, dynamic_mask: NDArray[np.bool_]) -> None:
        """Remember what was fused after the first frame, or that the map began anew with it."""
        if not self._window:
            return
        if view.timestamp <= self._window[0].view.timestamp:
            self._window, self._num_fused = [], 0
        if self._num_fused % WINDOW_STEP == 0:
            self._window.append(StartFrame(view, estimate, dynamic_mask, fused=True))
        self._num_fused += 1

    def complete_window(self) -> list[StartFrame]:
        """Every ``WINDOW_STEP``-th fused frame, in the order of time, once these are ``WINDOW``; they are forgotten
        then. Before, none."""
        if not self._window or self._num_fused < WINDOW:
            return []
        window, self._window = self._window, []
        return sorted(window, key=lambda frame: frame.view.timestamp)

    def add(self, view: FrameView, estimate: PoseEstimate, dynamic_mask: NDArray[np.bool_], *, fused: bool) -> None:
        """Remember another frame of the first moments."""
        if self._frames:
            self._frames.append(StartFrame(view, estimate, dynamic_mask, fused))

    def recolored(self, view: FrameView) -> StartFrame | None:
        """The first frame with other colours; None if it is no longer remembered."""
        if self._frames:
            self._frames[0] = replace(self._frames[0], view=view)
        return self._frames[0] if self._frames else None

    def revised(self, moving_before: NDArray[np.bool_] | None) -> StartFrame | None:
        """The first frame with the mask it should have been fused with; None where the map is right as it is.

        The others then count as not fused.

        Args:
            moving_before: (h, w) bool, label resolution, what a later image shows to have moved in the first; None if
                that is not known.
        """
        if not self._frames or moving_before is None:
            return None
        first = self._frames[0]
        labelled = first.view.labelled
        if not exceeds_noise_share(moving_before & ~reduced(first.dynamic_mask, labelled), labelled):
            return None
        moving = full_size(moving_before, labelled.depth, first.view.observation.depth)
        first = replace(first, dynamic_mask=first.dynamic_mask | moving)
        self._frames = [first, *(replace(frame, fused=False) for frame in self._frames[1:])]
        return first

    def released(self) -> list[StartFrame]:
        """The frames that are to be fused yet, without what has moved until the last of them; they are forgotten.

        A frame that follows no common motion with the last one is left out.
        """
        if not self._frames:
            return []
        last, frames = self._frames[-1], [frame for frame in self._frames[:-1] if not frame.fused]
        now = last.view.timestamp
        interval = (now - self._frames[0].view.timestamp) / max(len(self._frames) - 1, 1)
        self._frames = []
        out = []
        for frame in frames:
            before = frame.view
            older = OlderImage(before.timestamp, frame.estimate.T_world_camera, before.pyramid, before.segmentation())
            intervals = (now - before.timestamp) / interval
            T_world_camera = last.estimate.T_world_camera
            motion = older.motion_to(last.view.pyramid, last.view.segmentation(), T_world_camera, intervals)
            if motion is not None and older.moving is not None:
                moving = full_size(older.moving, before.labelled.depth, before.observation.depth)
                out.append(replace(frame, dynamic_mask=frame.dynamic_mask | moving))
        return out if last.fused else [*out, last]

    def abandon(self) -> None:
        """Forget the frames: the camera is tracked in another map."""
        self._frames, self._window = [], []
