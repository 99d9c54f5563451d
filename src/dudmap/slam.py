"""The algorithm: track a frame against the map, find what moves, fuse what does not (thesis algorithm 4)."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap import se3
from dudmap.atlas import Atlas
from dudmap.bodies import Body, RigidFusion
from dudmap.camera import Camera
from dudmap.config import Config
from dudmap.delay import DepthDelay
from dudmap.dynamics import DynamicDetector, Labels, full_mask, full_size, grown_mask
from dudmap.frame import Frame
from dudmap.health import TrackingHealth
from dudmap.history import History
from dudmap.loops import LoopCloser, View
from dudmap.motion import MotionModel
from dudmap.movers import Mover, MoverTracker
from dudmap.parallax import DominantMotion, Parallax, several
from dudmap.preprocess import Observation, Preprocessor, exposed_color, pyramid
from dudmap.relocalization import Keyframes, agree
from dudmap.result import Clock, FrameResult
from dudmap.similarity import SimilarityTest
from dudmap.surfaces import Pieces
from dudmap.tracker import Level, Tracker, TrackingResult
from dudmap.trajectory import Trajectory
from dudmap.volume import FREE, NOTHING, SURFACE, TsdfVolume

AS_EXPECTED = 0.02
"""Share of the surface whose labels may differ from the last frame's where one level is registered a second time."""
CLEARLY = 0.95
"""A pose explains an image clearly better than another if its cost is below this share of the other's."""
FLAT = 0.01
"""An image whose intensities (0..1) have a smaller standard deviation shows nothing: black, or blinded."""
SAME_START = 0.01, 0.25
"""Poses nearer to each other than this (m, deg) lead to the same registration."""
LEAST_KNOWN = 0.09
"""Share of the readings that must rest on a surface of the map where most of the others move."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A frame made ready by ``Slam.prepare``.

    Attributes:
        observation: Its images, filtered.
        levels: Image pyramid by number of halvings.
        surface: Gives its pieces of surface, None where they are not asked; waits until they are cut.
        ms: How long that took.
    """

    observation: Observation
    levels: dict[int, Level]
    surface: Callable[[], Pieces] | None
    ms: float


class Slam:
    """Dense RGB-D SLAM in scenes where things move.

    Args:
        camera: Camera of the frames that will come.
        config: All parameters; None = defaults.
        first_pass: A system that has seen the whole recording. The frames, given once more from the first on, are
            then registered and labelled with its map, which knows the end, and make a map of their own: what was
            taken for static before it moved, or before it was seen through, is left out.
    """

    def __init__(self, camera: Camera, config: Config | None = None, first_pass: "Slam | None" = None) -> None:
        self.config = config or Config()
        self.preprocess = Preprocessor(camera, self.config.preprocess)
        self.camera = self.preprocess.camera
        self.tracker = Tracker(self.config.tracker, self.config.sensor)
        by_distance = self.config.tracker.model_copy(update={"color_weight": 0.0, "exposure": False})
        self.blind_tracker = Tracker(by_distance, self.config.sensor)
        self.detector = DynamicDetector(self.config.dynamics, self.config.sensor)
        self.similarity = SimilarityTest(self.config.similarity)
        self.motion = MotionModel(self.config.tracker)
        self.delay = DepthDelay()
        self.health = TrackingHealth()
        self.keyframes = Keyframes(self.config.relocalization, self.camera, self.config.sensor)
        self.atlas = Atlas(self._empty_volume, self.keyframes, self._history())
        self._knowledge: TsdfVolume | None = None  # the map of a first pass, and where it saw the frames
        self._seen: dict[float, NDArray[np.float64]] = {}
        if first_pass is not None:
            main = first_pass.atlas.by_size()[0]
            self.keyframes = first_pass.keyframes
            self.atlas = Atlas(self._empty_volume, self.keyframes, None, main)
            self._knowledge = first_pass.atlas.volumes[main]
            self._seen = {p.timestamp: p.T_world_camera for p in first_pass.atlas.poses if p.submap == main}
            self.detector.memory.know(first_pass.detector.memory, self._seen)
        self.loops = LoopCloser(self.config, self.atlas, self.tracker)
        self.movers = MoverTracker(self.config.movers)
        self.fusion = RigidFusion(self.config) if self.config.movers.enabled and self.config.movers.meshes else None
        self.parallax = Parallax(self.config.dynamics.start_seconds)
        self._first: tuple[Observation, NDArray[np.bool_]] | None = None  # until a second frame shows what moves in it
        self._lost_since: float | None = None
        self._T_world_fused: NDArray[np.float64] | None = None
        self._moved: NDArray[np.bool_] | None = None  # label image of the last tracked frame
        self._unproven: NDArray[np.bool_] | None = None  # label image: what nothing shows to rest, while a crowd moves
        self._crowd = False  # most of the view has moved from the first frame on
        self._blind, self._map_blind = False, False  # the present image, and that of the map's first frame, are flat
        self._untested = 0  # frames that are still fused without the similarity test

    @property
    def volume(self) -> TsdfVolume:
        """The map that is tracked; another one after a new submap was started or two were joined."""
        return self.atlas.volume

    @property
    def reference(self) -> TsdfVolume:
        """The map that frames are compared with: the own one, or in a second pass that of the first."""
        return self._knowledge or self.volume

    @property
    def trajectory(self) -> Trajectory:
        """Poses of all frames tracked so far in the submap with the most frames, as they are known now."""
        return self.atlas.trajectory(self.atlas.by_size()[0])

    @property
    def maps(self) -> list[tuple[Trajectory, TsdfVolume]]:
        """Trajectory and map of each submap, that with the most frames first; each has a world of its own."""
        return [(self.atlas.trajectory(number), self.atlas.volumes[number]) for number in self.atlas.by_size()]

    @property
    def bodies(self) -> list[Body]:
        """The moving bodies so far, where ``movers.meshes`` is set: shape and trajectory of those that are rigid."""
        if self.fusion is None:
            return []
        return self.fusion.bodies({pose.timestamp: pose.T_world_camera for pose in self.atlas.poses})

    def prepare(self, frame: Frame) -> Prepared:
        """The part of a frame's work that needs no other frame, for ``process`` to go on with.

        Another thread may do it while an earlier frame is processed; one frame at a time.

        Raises:
            DatasetError: The images do not fit the camera or each other.
        """
        start = time.perf_counter()
        observation = self.preprocess(frame)
        levels = self._levels(observation)
        surface = None
        if self.config.dynamics.method == "em":
            surface = self.detector.cut(self._compared(levels)[1], self.config.volume.voxel_size)
        return Prepared(observation, levels, surface, 1000 * (time.perf_counter() - start))

    def process(self, frame: Frame | Prepared, dynamic_mask: NDArray[np.bool_] | None = None) -> FrameResult:
        """Track one frame against the map, find what moves, fuse what does not.

        Args:
            frame: Depth and colour with a timestamp later than all before; prepared or not, the result is the same.
            dynamic_mask: (H, W) bool, pixels of the frame that are known to move, e.g. of a segmentation network;
                they count as moving from the first registration on, whatever is found besides.

        Raises:
            DatasetError: The images do not fit the camera or each other.
        """
        prepared = frame if isinstance(frame, Prepared) else self.prepare(frame)
        observation, levels, clock = prepared.observation, prepared.levels, Clock({"preprocess": prepared.ms})
        known = None if dynamic_mask is None else self.preprocess.mask(dynamic_mask)
        flat = bool(self._tracked(levels)[0].intensity.std() < FLAT)
        self._blind = flat and not self._map_blind
        if self.reference.is_empty:
            self._map_blind = flat
            return self._as_recorded(self._start(observation, levels, known, clock))
        if prepared.surface is not None:
            self.detector.take(self._compared(levels)[1], prepared.surface)
            if not self.atlas.poses:  # a second pass begins
                self.parallax.start(observation.timestamp)
        T_init, moving = self._expect(observation, levels, clock)
        self.detector.begin(observation.timestamp, moving)
        tracked, labels = self._register(observation, levels, T_init, known, clock)
        reason = self._doubt(observation.timestamp, levels, tracked, labels)
        recognised = self._recognise(observation, levels, known, clock) if reason else None
        if recognised is not None:
            (tracked, labels), reason = recognised, ""
            self.motion.restart(observation.timestamp, tracked.T_world_camera)
        if reason:
            self._lose(observation.timestamp)
            if self._start_submap(observation):
                return self._as_recorded(self._start(observation, levels, known, clock))
            return self._as_recorded(
                self._result(observation, clock, levels, labels, known, tracked, reason, fused=False)
            )
        self._keep(observation.timestamp, levels, tracked, labels)
        with clock("similarity"):
            redundant = not self._blind and self._redundant(observation, tracked.T_world_camera)
        fused = not (redundant or self._blind)
        result = self._result(
            observation, clock, levels, labels, known, tracked, "", fused=fused, relocalized=bool(recognised)
        )
        self._remember(observation, tracked.T_world_camera, result.dynamic_mask, clock)
        if fused:
            with clock("integrate"):
                self._integrate(observation, tracked.T_world_camera, result.dynamic_mask, tracked.exposure)
        return self._as_recorded(self._close_loop(observation, levels, result, clock))

    def _keep(self, timestamp: float, levels: dict[int, Level], tracked: TrackingResult, labels: Labels | None) -> None:
        """Take over a frame whose pose is believed: what the next one is predicted and judged from."""
        velocity = self.motion.update(timestamp, tracked.T_world_camera)
        self.health.tracked(tracked)
        self._lost_since = None
        self._moved = None if labels is None else labels.dynamic
        self.atlas.add_pose(timestamp, tracked.T_world_camera)
        if self._blind:
            self.parallax.forget()
            return
        self._compare_with_next(timestamp, levels)
        if labels is not None:
            coarse, level = self._tracked(levels)[0], levels[self._level(self.config.dynamics.width)]
            weights = self._weights(labels, [coarse])[0]
            self.delay.learn(self.tracker, self.reference, coarse, tracked.T_world_camera, velocity, weights)
            self.detector.remember(level, tracked.T_world_camera, tracked.exposure, labels)

    def _as_recorded(self, result: FrameResult) -> FrameResult:
        """The mask back in the image that came in, where the lens bends straight lines."""
        return replace(result, dynamic_mask=self.preprocess.distorted(result.dynamic_mask))

    def _start(
        self, observation: Observation, levels: dict[int, Level], known: NDArray[np.bool_] | None, clock: Clock
    ) -> FrameResult:
        """The first frame with readings is the world: identity pose, what is not known to move is taken as static."""
        nothing = np.zeros(observation.depth.shape, dtype=bool) if known is None else known
        readings = np.count_nonzero(observation.depth[~nothing])
        reason = "" if readings >= 0.02 * observation.depth.size else "the depth image holds hardly any readings"
        T = np.eye(4)
        if not reason:
            self.motion.update(observation.timestamp, T)
            self.atlas.add_pose(observation.timestamp, T)
            self._remember(observation, T, nothing, clock)
            with clock("integrate"):
                self._integrate(observation, T, nothing)
            if self.config.dynamics.method == "em":
                self.parallax.start(observation.timestamp)
                self._crowd = True
                self._first = observation, nothing
                self.detector.begin(observation.timestamp)
                self.detector.memory.start()
                small = self._compared(levels)[1]
                self.detector.memory.remember(small, T, np.zeros(small.depth.shape, dtype=bool), None)
            self._compare_with_next(observation.timestamp, levels)
        return FrameResult(
            observation.timestamp, "lost" if reason else "tracked", reason, None if reason else T, not reason, False,
            nothing, _share(nothing, observation), np.full((1, 1), np.nan, np.float32), None, None, clock.timings,
            submap=self.atlas.current,
        )  # fmt: skip

    def _expect(
        self, observation: Observation, levels: dict[int, Level], clock: Clock
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_] | None]:
        """First guess of the pose; with what moves (h, w) while the map is young, or movers hide most of the view:
        both then come from the last image and this one."""
        T_init = self._seen.get(observation.timestamp, self.motion.predict(observation.timestamp))
        self._unproven = None
        if not self.parallax.active:
            return T_init, None
        with clock("parallax"):
            seen = self._see(observation, levels)
            if seen is None:
                return T_init, None
            motion, T_seen = seen
            level, small = self._compared(levels)
            if self._first is not None:
                self._start_again(*self._first, motion.moving_before, small)
            elif observation.timestamp in self._seen:
                T_seen = T_init
            elif self._fits_better(T_init, T_seen, self._tracked(levels)[0]):
                return T_init, None  # what most corners follow is not the static world
            moving = motion.moving_after
            if not several(moving, small):  # else something slow hardly drags the camera on its own
                moving = moving | self.parallax.slow(
                    observation.timestamp, T_seen, level, small, self.detector.pieces(small, self.volume)
                )
            self._crowd = self._crowd and self.parallax.young(observation.timestamp) and _mostly(moving, small)
            if self._crowd:
                self._unproven = ~motion.resting_after
            if not self.parallax.young(observation.timestamp):  # elsewhere the map knows better what moves
                moving = moving & (self._place(small, T_seen) == NOTHING)
            return T_seen, moving

    def _see(
        self, observation: Observation, levels: dict[int, Level]
    ) -> tuple[DominantMotion, NDArray[np.float64]] | None:
        """The static world's motion from the last image to this one, and the pose (4, 4) it leads to, if known."""
        level, small = self._compared(levels)
        surface = self.detector.pieces(small, self.volume)
        motion = self.parallax.compare(observation.timestamp, level, small, surface)
        if motion is None:
            return None
        return motion, self.atlas.poses[-1].T_world_camera @ se3.inverse(motion.T_after_before)

    def _place(self, level: Level, T_world_camera: NDArray[np.float64]) -> NDArray[np.uint8]:
        """What the map knows of the points of an image (h, w): SURFACE, FREE or NOTHING."""
        self.reference.look_at(T_world_camera)
        return self.reference.sample(level.depth, level.intensity, level.camera, T_world_camera).place

    def _fits_better(self, T: NDArray[np.float64], T_other: NDArray[np.float64], level: Level) -> bool:
        """Whether a pose explains an image clearly better than another one, apart from what has just moved."""
        weights = self._expected([level], None) or [np.ones_like(level.depth)]
        static = np.where(self._place(level, T) == FREE, np.float32(0), weights[0])
        cost, other = (self.tracker.linearize(self.reference, level, pose, static).cost for pose in (T, T_other))
        return cost < CLEARLY * other

    def _start_again(
        self, first: Observation, known: NDArray[np.bool_], moving: NDArray[np.bool_], level: Level
    ) -> None:
        """Make the map of the first frame anew without what the second shows to move in it."""
        self._first = None
        small = pyramid(first, self._level(self.config.dynamics.width))[0]
        if np.count_nonzero(moving) > 0:
            self.volume.clear()
            if self.atlas.history is not None:
                self.atlas.history.drop_last()
            self._integrate(first, np.eye(4), known | full_size(moving, small, first.depth))

    def _compared(self, levels: dict[int, Level]) -> tuple[Level, Level]:
        return levels[self._level(max(self.config.tracker.widths))], levels[self._level(self.config.dynamics.width)]

    def _compare_with_next(self, timestamp: float, levels: dict[int, Level]) -> None:
        if self.config.dynamics.method != "em" or self.config.dynamics.start_seconds == 0:
            return
        level, small = self._compared(levels)
        pieces, T_world_camera = self.detector.pieces(small, self.volume), self.atlas.poses[-1].T_world_camera
        self.parallax.remember(timestamp, T_world_camera, level, small, pieces, self._moved)

    def _register(
        self,
        observation: Observation,
        levels: dict[int, Level],
        T_init: NDArray[np.float64],
        known: NDArray[np.bool_] | None,
        clock: Clock,
    ) -> tuple[TrackingResult, Labels | None]:
        """Register and label a frame; if it fits unusually badly, or the registration was still on its way, once more
        from where the last image puts the camera.

        A hand that turns back, or frames that are missing, leave a first guess beyond the reach of the registration.
        What fits the map better is taken.
        """
        tracked, labels = self._register_from(levels, T_init, known, clock)
        arrived = tracked.settled or agree(T_init, tracked.T_world_camera, *SAME_START)
        if arrived and not self.health.unusual(tracked):
            return tracked, labels
        with clock("parallax"):
            seen = self._see(observation, levels)
        if seen is None or agree(seen[1], tracked.T_world_camera, *SAME_START):
            return tracked, labels
        again, labels_again = self._register_from(levels, seen[1], known, clock)
        misfit, misfit_again = sum(self.health.misfit(tracked)), sum(self.health.misfit(again))
        better = again.converged and (not tracked.converged or misfit_again < CLEARLY * misfit)
        return (again, labels_again) if better else (tracked, labels)

    def _register_from(
        self, levels: dict[int, Level], T_init: NDArray[np.float64], known: NDArray[np.bool_] | None, clock: Clock
    ) -> tuple[TrackingResult, Labels | None]:
        """Register without labels, find what moves, register again without that (thesis algorithm 4).

        The coarse levels bring the pose near enough to tell what moves, the fine ones make it exact.
        """
        tracked_levels = self._tracked(levels)
        unmasked = self._unmasked(tracked_levels, known)
        tracker = self.blind_tracker if self._blind else self.tracker
        if self.config.dynamics.method == "none" or not self.config.tracker.second_pass:
            with clock("track"):
                tracked = tracker.align(self.reference, tracked_levels, T_init, unmasked)
            if self.config.dynamics.method == "none":
                return tracked, None
            return tracked, self._detect(levels, tracked, known, clock)
        split = max(1, len(tracked_levels) - 1)
        with clock("track"):
            weights = self._expected(tracked_levels, unmasked)
            tracked = tracker.align(self.reference, tracked_levels[:split], T_init, weights)
        labels = self._detect(levels, tracked, known, clock)
        with clock("track_again"):
            enough = split < len(tracked_levels) and tracked.settled and self._as_expected(labels)
            first = split if enough else split - 1
            again = tracked_levels[first:]
            tracked = tracker.align(
                self.reference,
                again,
                tracked.T_world_camera,
                self._weights(labels, again),
                first_level=first,
                exposure=tracked.exposure,
            )
        if self._blind:
            tracked = replace(tracked, color_residual=np.nan)
        return tracked, labels

    def _unmasked(self, levels: list[Level], known: NDArray[np.bool_] | None) -> list[NDArray[np.float32]] | None:
        """Weights of 0 for what is known to move, or seen to from image to image; None where nothing is."""
        masks = [mask for mask in (known, self.detector.moving, self._unproven) if mask is not None]
        if not masks:
            return None
        return [(~np.any([_reduced(mask, level) for mask in masks], axis=0)).astype(np.float32) for level in levels]

    def _expected(
        self, levels: list[Level], unmasked: list[NDArray[np.float32]] | None
    ) -> list[NDArray[np.float32]] | None:
        """Weights of the first registration: what moved in the last frame has little say in this one."""
        if self._moved is None:
            return unmasked
        weights = [np.float32(1) - np.float32(0.9) * _reduced(self._moved, level) for level in levels]
        return weights if unmasked is None else [a * b for a, b in zip(weights, unmasked, strict=True)]

    def _as_expected(self, labels: Labels) -> bool:
        """Whether so little of what lies on the map moves other than in the last frame that no coarser level need be
        registered again."""
        changed = labels.dynamic if self._moved is None else labels.dynamic != self._moved
        counted = labels.sample.place == SURFACE  # nothing else has a say in the registration
        return bool(np.count_nonzero(changed & counted) <= AS_EXPECTED * np.count_nonzero(counted))

    def _doubt(self, timestamp: float, levels: dict[int, Level], tracked: TrackingResult, labels: Labels | None) -> str:
        """Sentence on why a registration is not to be believed, empty if it is."""
        crowded = labels is not None and _mostly(labels.dynamic, self._compared(levels)[1])
        return (
            tracked.reason
            or self.motion.implausible(timestamp, tracked.T_world_camera)
            or self.health.doubt(tracked, crowded=crowded)
            or self._undecided(levels, labels, tracked)
        )

    def _undecided(self, levels: dict[int, Level], labels: Labels | None, tracked: TrackingResult) -> str:
        """Sentence if so much seems to move, or so little of the rest is known, that nothing is certain."""
        if labels is None:
            return ""
        readings = levels[self._level(self.config.dynamics.width)].depth > 0
        share = np.count_nonzero(labels.dynamic & readings) / max(np.count_nonzero(readings), 1)
        if share > self.config.dynamics.max_share:
            return f"{share:.0%} of the readings seem to move: the static world cannot be told"
        known = (1 - share) * tracked.inlier_share
        if share > 0.5 and known < LEAST_KNOWN:
            return f"{share:.0%} of the readings seem to move, and only {known:.0%} rest where the map has a surface"
        return ""

    def _remember(
        self,
        observation: Observation,
        T_world_camera: NDArray[np.float64],
        dynamic_mask: NDArray[np.bool_],
        clock: Clock,
    ) -> None:
        """Keep the frame as a keyframe if the camera has been nowhere near and the image shows something."""
        if self.config.relocalization.enabled and not self._blind:
            with clock("keyframe"):
                self.keyframes.add(observation, T_world_camera, ~dynamic_mask, self.atlas.current)

    def _recognise(
        self, observation: Observation, levels: dict[int, Level], known: NDArray[np.bool_] | None, clock: Clock
    ) -> tuple[TrackingResult, Labels | None] | None:
        """Registration of a lost frame from the pose of a place it shows; None where nothing is beyond doubt.

        Features and map must agree: the registration passes all checks at the stricter limits that hold after a loss,
        enough of the frame lies on the map, and the pose stays where the features put it.
        """
        config = self.config.relocalization
        if not config.enabled:
            return None
        self.health.lost()
        readings = max(np.count_nonzero(levels[self._level(self.config.dynamics.width)].depth), 1)
        with clock("recognise"):
            candidates = self.keyframes.find(observation, None if known is None else ~known)
        lost_in = self.atlas.current
        candidates.sort(key=lambda place: place.keyframe.submap != lost_in)  # rather stay than change the map
        for place in candidates:
            T_world_camera, self.atlas.current = place.T_world_camera, place.keyframe.submap
            tracked, labels = self._register_from(levels, T_world_camera, known, clock)
            static = 1.0 if labels is None else 1 - np.count_nonzero(labels.dynamic) / readings
            if (
                tracked.converged
                and not self.health.doubt(tracked, recognised=True)
                and static * tracked.inlier_share >= config.min_on_map
                and agree(tracked.T_world_camera, T_world_camera, config.max_distance, config.max_angle_deg)
            ):
                return tracked, labels
        self.atlas.current = lost_in
        return None

    def _lose(self, timestamp: float) -> None:
        self.motion.lost(timestamp)
        self.health.lost()
        self.detector.forget()
        self._moved = None
        self._lost_since = timestamp if self._lost_since is None else self._lost_since

    def _start_submap(self, observation: Observation) -> bool:
        """Go on in a new, empty map if nothing has been recognised for a while and this frame shows enough."""
        config = self.config.submaps
        if not config.enabled or self.atlas.history is None or self._lost_since is None:
            return False
        if observation.timestamp - self._lost_since < config.patience:
            return False
        if np.count_nonzero(observation.depth) < config.min_readings * observation.depth.size:
            return False
        if len(self.keyframes.features(observation).points) < self.config.relocalization.min_inliers:
            return False
        self.atlas.start_submap()
        self.motion, self.health = MotionModel(self.config.tracker), TrackingHealth()
        self._T_world_fused, self._lost_since = None, None
        return True

    def _close_loop(
        self, observation: Observation, levels: dict[int, Level], result: FrameResult, clock: Clock
    ) -> FrameResult:
        """Look for a place seen before; where the tracking has drifted since, everything moves."""
        tracked = result.tracking
        if self.atlas.history is None or tracked is None or self._blind:
            return result
        with clock("loops"):
            tracked_levels = self._tracked(levels)
            weights = None if result.labels is None else self._weights(result.labels, tracked_levels)
            view = View(observation, tracked_levels, weights, ~result.dynamic_mask, tracked)
            correction = self.loops.close(view, self.health)
        if correction is None:
            return result
        self.motion.moved(correction)
        if self._T_world_fused is not None:
            self._T_world_fused = correction @ self._T_world_fused
        T = correction @ tracked.T_world_camera
        return replace(result, T_world_camera=T, submap=self.atlas.current, corrected=True)

    def _empty_volume(self) -> TsdfVolume:
        return TsdfVolume(self.camera, self.config.volume, self.config.sensor, self.config.preprocess.depth_max)

    def _history(self) -> History | None:
        loops = self.config.loops
        if not self.config.relocalization.enabled or not (loops.enabled or self.config.submaps.enabled):
            return None
        return History(self.camera, loops.keep_distance, loops.keep_angle_deg, loops.keep_gap)

    def _levels(self, observation: Observation) -> dict[int, Level]:
        """Image pyramid by number of halvings."""
        wanted = {self._level(width) for width in (*self.config.tracker.widths, self.config.dynamics.width)}
        return {
            level: Level(self.camera.scaled(level), depth, intensity)
            for level in sorted(wanted)
            for depth, intensity in [pyramid(observation, level)]
        }

    def _level(self, width: int) -> int:
        """Number of halvings that brings the camera's image nearest to a width."""
        return max(0, round(np.log2(self.camera.width / width)))

    def _tracked(self, levels: dict[int, Level]) -> list[Level]:
        return [levels[self._level(width)] for width in self.config.tracker.widths]

    def _detect(
        self, levels: dict[int, Level], tracked: TrackingResult, known: NDArray[np.bool_] | None, clock: Clock
    ) -> Labels:
        level = levels[self._level(self.config.dynamics.width)]
        with clock("label"):
            T_depth = tracked.T_world_camera
            if not self._blind:
                velocity = self.motion.velocity_to(self.detector.now, T_depth)
                T_depth = self.delay.depth_pose(self._tracked(levels)[0], T_depth, velocity)
            labels = self.detector.detect(self.reference, level, T_depth, tracked.exposure)
            if self._blind:
                labels = replace(labels, hidden=None)
            if known is None:
                return labels
            masked = _reduced(known, level)
            static_probability = np.where(masked, np.float32(0), labels.static_probability)
            return replace(labels, dynamic=labels.dynamic | masked, static_probability=static_probability)

    def _weights(self, labels: Labels, levels: list[Level]) -> list[NDArray[np.float32]]:
        """Static weights of the second registration at every level."""
        import cv2

        static = labels.static_probability
        if self._unproven is not None:
            static = np.where(self._unproven, np.float32(0), static)
        return [
            np.asarray(cv2.resize(static, level.depth.shape[::-1], interpolation=cv2.INTER_NEAREST), np.float32)
            for level in levels
        ]

    def _redundant(self, observation: Observation, T_world_camera: NDArray[np.float64]) -> bool:
        """The similarity test, asked only where the camera has hardly moved since the last fused frame."""
        config = self.config.similarity
        if not config.enabled or self._T_world_fused is None:
            return False
        moved = se3.inverse(self._T_world_fused) @ T_world_camera
        if config.max_translation > 0 and (
            np.linalg.norm(moved[:3, 3]) > config.max_translation
            or np.degrees(se3.rotation_angle(moved)) > config.max_rotation_deg
        ):
            return False
        if self._untested > 0:
            self._untested -= 1
            return False
        redundant = self.similarity.redundant(observation.rgb)
        self._untested = 0 if redundant else config.patience
        return redundant

    def _integrate(
        self,
        observation: Observation,
        T_world_camera: NDArray[np.float64],
        dynamic_mask: NDArray[np.bool_],
        exposure: tuple[float, float] = (1.0, 0.0),
    ) -> None:
        static = ~grown_mask(dynamic_mask, self.config.dynamics.margin_px * self.camera.width // 640)
        fused = Frame(observation.timestamp, observation.depth, exposed_color(observation.rgb, exposure))
        self.volume.integrate(fused, T_world_camera, static)
        if self.atlas.history is not None:
            self.atlas.history.add(fused, static, T_world_camera, self.atlas.current)
        self._T_world_fused = T_world_camera
        if self.config.similarity.enabled:
            self.similarity.accept(observation.rgb)

    def _result(
        self,
        observation: Observation,
        clock: Clock,
        levels: dict[int, Level],
        labels: Labels | None,
        known: NDArray[np.bool_] | None,
        tracked: TrackingResult,
        reason: str,
        *,
        fused: bool,
        relocalized: bool = False,
    ) -> FrameResult:
        with clock("label"):
            if labels is None:
                mask = np.zeros(observation.depth.shape, dtype=bool)
                residuals = np.full((1, 1), np.nan, np.float32)
            else:
                level = levels[self._level(self.config.dynamics.width)]
                mask = full_mask(labels, level, observation.depth)
                residuals = labels.sample.distance
            if known is not None:
                mask = mask | known
        movers: tuple[Mover, ...] = ()
        if self.config.movers.enabled and labels is not None and not reason:
            with clock("movers"):
                level = levels[self._level(self.config.dynamics.width)]
                movers = tuple(self.movers.update(observation.timestamp, labels.dynamic, level, tracked.T_world_camera))
            if self.fusion is not None:
                with clock("bodies"):
                    pose, exposure = tracked.T_world_camera, tracked.exposure
                    movers = tuple(self.fusion.update(observation, movers, level, pose, exposure))
        return FrameResult(
            observation.timestamp, "lost" if reason else "tracked", reason, None if reason else tracked.T_world_camera,
            fused, not (fused or reason or self._blind), mask, _share(mask, observation), residuals, labels, tracked,
            clock.timings, relocalized, movers, self.atlas.current, blind=self._blind,
        )  # fmt: skip


def _reduced(mask: NDArray[np.bool_], level: Level) -> NDArray[np.bool_]:
    """Mask (H, W) at the size of a level: pixels any part of which lies in it."""
    import cv2

    size = level.depth.shape[::-1]
    return np.asarray(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)) > 0


def _mostly(moving: NDArray[np.bool_], level: Level) -> bool:
    """Whether more than half of the readings of an image move (h, w)."""
    return bool(2 * np.count_nonzero(moving) > np.count_nonzero(level.depth))


def _share(mask: NDArray[np.bool_], observation: Observation) -> float:
    """Share of the readings that lie in a mask."""
    readings = observation.depth > 0
    return float(np.count_nonzero(mask & readings) / max(np.count_nonzero(readings), 1))
