"""Loop closing: recognise places and remove the drift since their last visit."""

import weakref
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.geometry import se3
from dudmap.core.geometry.se3 import agree
from dudmap.core.places.atlas import Atlas
from dudmap.core.places.frame_thinning import FrameThinning
from dudmap.core.places.loop_correction import LoopCorrector
from dudmap.core.places.loop_verification import LoopQuery, LoopVerifier
from dudmap.core.places.place_recognition import Keyframe, PlacedFeatures, PlaceMatch
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.quality_monitor import QualityMonitor
from dudmap.core.tracking.tracker import Tracker

NEAR_DISTANCE, NEAR_ANGLE_DEG = 0.5, 30.0
"""Distance (reference depths) and angle (deg) at which a keyframe counts as seen."""
CHECK_INTERVAL = 5
"""Frames between checks for nearby keyframes, and between start and evaluation of a search."""
SAME_DISTANCE, SAME_ANGLE_DEG = 0.03, 1.0
"""Largest difference of corrections that confirm each other, reference depths and degrees."""
NO_DRIFT, NO_DRIFT_DEG = 0.02, 0.7
"""Corrections within the noise, reference depths and degrees."""
MAX_VERIFIED = 2
"""Matches of one frame that are verified by registration."""
MAX_BACKOFF = 4
"""Largest back-off: after n failed searches the next waits n ``loops.gap`` frames."""


@dataclass(frozen=True, eq=False)
class LoopSearch:
    """A tracked frame that is matched in the background.

    ``returned``: Nearby keyframes have not been seen for ``loops.min_age``, so that a match is expected. ``due``: Frame
    number of the evaluation.
    """

    query: LoopQuery
    submap: int
    returned: bool
    matches: "Future[list[PlaceMatch]]"
    due: int


class LoopCloser(Stateful):
    """Detects, verifies and closes loops, and joins submaps.

    Features (3D-3D RANSAC), distances and intensities of the local map must give the same pose. A second frame must
    confirm the correction, and the newest must not be registered to the older surfaces. Matching is evaluated
    ``CHECK_INTERVAL`` frames later, independent of timing. ``closed`` counts corrections and joins.
    """

    corrector: Remembered[LoopCorrector]
    thinning: Remembered[FrameThinning]
    closed: Remembered[int] = 0
    _frame: Remembered[int] = 0
    _next_search: Remembered[int] = 0
    _failures: Remembered[int] = 0
    # timestamp, because the number of keyframes saturates at ``max_keyframes``
    _newest_keyframe: Remembered[float | None] = None
    _search: Remembered[LoopSearch | None] = None
    # submap, and unconfirmed correction (4, 4) of the current world that one frame measured
    _pending: Remembered[tuple[int, NDArray[np.float64]] | None] = None

    def __init__(self, config: Config, atlas: Atlas, tracker: Tracker) -> None:
        self.config = config
        self.atlas = atlas
        self.verifier = LoopVerifier(config, atlas, tracker)
        self.corrector = LoopCorrector(atlas)
        self.thinning = FrameThinning(config, atlas)
        self._executor: ThreadPoolExecutor | None = None

    def close(self, query: LoopQuery, monitor: QualityMonitor) -> NDArray[np.float64] | None:
        """Search for a loop closure with a tracked frame, and evaluate the last search when due.

        Returns the correction (4, 4) of the camera pose, or None. ``monitor`` judges registrations.
        """
        self._frame += 1
        self.thinning.thin()
        if self._search is not None:
            if self._frame < self._search.due:
                return None
            search, self._search = self._search, None
            if search.submap == self.atlas.current:
                return self._evaluate(search, query, monitor)
        keyframes = self.atlas.keyframes.keyframes
        newest = keyframes[-1].timestamp if keyframes else None
        new_keyframe, self._newest_keyframe = newest != self._newest_keyframe, newest
        if not new_keyframe and self._frame % CHECK_INTERVAL:
            return None
        now, T = query.observation.timestamp, query.tracking.T_world_camera
        near = self.atlas.keyframes.near(T, self.atlas.current, NEAR_DISTANCE * self.atlas.unit, NEAR_ANGLE_DEG)
        returned = any(self._is_old(keyframe, now) for keyframe in near)
        candidates = [keyframe for keyframe in keyframes if self._is_candidate(keyframe, now)]
        wanted = new_keyframe or returned or self._pending is not None or len(self.atlas.volumes) > 1
        if candidates and wanted and self._frame >= self._next_search:
            self._start_search(query, candidates, returned)
        if not returned:  # keyframes of a revisited place keep their age until the search is evaluated
            _mark_seen(near, now)
        return None

    def _start_search(self, query: LoopQuery, candidates: list[Keyframe], returned: bool) -> None:
        if self._executor is None:
            self._executor = ThreadPoolExecutor(1, thread_name_prefix="dudmap-loops")
            weakref.finalize(self, self._executor.shutdown, wait=False)
        matches = self._executor.submit(self.atlas.keyframes.match, self._features(query), candidates)
        self._search = LoopSearch(query, self.atlas.current, returned, matches, self._frame + CHECK_INTERVAL)
        self._next_search = self._frame + self.config.loops.gap

    def _features(self, query: LoopQuery) -> PlacedFeatures:
        keyframes, T = self.atlas.keyframes.keyframes, query.tracking.T_world_camera
        newest = keyframes[-1] if keyframes else None
        # a keyframe of a saved map may have the same time, but not the same pose
        if newest and newest.timestamp == query.observation.timestamp and np.array_equal(newest.T_world_camera, T):
            self.atlas.keyframes.settle()
            return newest.features
        return self.atlas.keyframes.extract(query.observation, query.dynamic_mask)

    def _is_old(self, keyframe: Keyframe, now: float) -> bool:
        return now - keyframe.last_seen > self.config.loops.min_age

    def _is_candidate(self, keyframe: Keyframe, now: float) -> bool:
        if keyframe.submap != self.atlas.current:
            return self.config.submaps.enabled
        correctable = self.config.loops.enabled and self.atlas.current != self.atlas.saved
        return correctable and self._is_old(keyframe, now)

    def _evaluate(self, search: LoopSearch, newest: LoopQuery, monitor: QualityMonitor) -> NDArray[np.float64] | None:
        """Verify the matches of a search; returns the correction of the pose, or None."""
        query, distance = search.query, NO_DRIFT * self.atlas.unit
        T = query.tracking.T_world_camera
        pending, self._pending = self._pending, None
        failed = search.returned
        for place in search.matches.result()[:MAX_VERIFIED]:
            submap = place.keyframe.submap
            in_current = submap == self.atlas.current
            # the feature pose is less accurate than the registration
            if in_current and agree(place.T_world_camera, T, 1.5 * distance, 1.5 * NO_DRIFT_DEG):
                return self._confirm_no_drift(place, query)
            if in_current and not self.verifier.plausibility(place, T).accepted:
                continue
            T_found = self.verifier.register(place, query, monitor)
            if T_found is None:
                failed = True
                continue
            self._failures = 0
            if in_current and agree(T_found, T, distance, NO_DRIFT_DEG):
                return self._confirm_no_drift(place, query)
            confirmed = (
                pending is not None
                and pending[0] == submap
                and agree(pending[1] @ T, T_found, SAME_DISTANCE * self.atlas.unit, SAME_ANGLE_DEG)
            )
            if not confirmed:
                self._pending = submap, T_found @ se3.inverse(T)
                self._next_search = self._frame
                return None
            T_corrected_tracked = T_found @ se3.inverse(T)
            if not in_current:
                return self._join(submap, T_corrected_tracked)
            if self.verifier.is_drifted(place, newest, T_corrected_tracked):
                return self._correct(place, query, T_found)
            failed = True
        if failed:  # registration is expensive: linear back-off
            self._failures = min(self._failures + 1, MAX_BACKOFF)
            self._next_search = self._frame + self._failures * self.config.loops.gap
        return None

    def _confirm_no_drift(self, place: PlaceMatch, query: LoopQuery) -> None:
        self._failures = 0
        T = query.tracking.T_world_camera
        edge = self.corrector.measured_edge(place.keyframe, T, T)
        if edge is not None:
            self.corrector.edges.append(edge)
        near = self.atlas.keyframes.near(T, self.atlas.current, NEAR_DISTANCE * self.atlas.unit, NEAR_ANGLE_DEG)
        _mark_seen(near, query.observation.timestamp)

    def _correct(self, place: PlaceMatch, query: LoopQuery, T_found: NDArray[np.float64]) -> NDArray[np.float64] | None:
        edge = self.corrector.measured_edge(place.keyframe, query.tracking.T_world_camera, T_found)
        correction = None if edge is None else self.corrector.correct(edge)
        self.closed += correction is not None
        return correction

    def _join(self, other: int, T_other_current: NDArray[np.float64]) -> NDArray[np.float64]:
        current = self.atlas.current
        self.closed += 1
        if other < current:
            self.atlas.join(current, other, T_other_current)
            return T_other_current
        self.atlas.join(other, current, se3.inverse(T_other_current))
        return np.eye(4)


def _mark_seen(keyframes: list[Keyframe], now: float) -> None:
    for keyframe in keyframes:
        keyframe.last_seen = now
