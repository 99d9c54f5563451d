"""Correction of a submap after a loop closure: pose graph optimization and a new map."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.exposure import fit_exposure
from dudmap.core.geometry import se3
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.atlas import Atlas
from dudmap.core.places.map_rebuilding import MAX_IMMEDIATE, nearest_views, view_distances
from dudmap.core.places.place_recognition import Keyframe
from dudmap.core.places.pose_graph import Edge, optimize
from dudmap.core.state import Remembered, Stateful

TRUNCATED_DISTANCE = 0.05
"""Truncation of distances in the misfit of frames to a map, reference depths."""
ODOMETRY_NOISE = 0.002, 0.02
"""Standard deviation of a tracked motion: reference depths (or radians), and per reference depth of path."""
LOOP_NOISE = 0.005, 0.003
"""Standard deviation of a loop closure: reference depths and radians."""
MAX_RATIO, MAX_OFFSETS = 1.5, (LOOP_NOISE[0], 0.01)
"""Largest misfit of the new pass to the old map: ratio times its misfit to its own map, plus offset (reference depths;
intensities 0..1). Correct corrections have 1.1; errors of 5 cm, or of 2 cm and 1 degree, more than 2."""


class LoopCorrector(Stateful):
    """Distributes the drift over the stored frames of the current submap. ``edges``: motions measured by loop
    closures."""

    edges: Remembered[list[Edge]]

    def __init__(self, atlas: Atlas) -> None:
        self.atlas = atlas
        self.edges = []

    def measured_edge(
        self, keyframe: Keyframe, T_tracked: NDArray[np.float64], T_measured: NDArray[np.float64]
    ) -> Edge | None:
        """Edge between two stored frames: the one nearest in time to the keyframe, and the newest. None if they are
        the same.

        ``T_tracked``: tracked pose (4, 4) of the recognised frame. ``T_measured``: its pose in the map at the time of
        the keyframe.
        """
        history = self.atlas.history
        assert history is not None
        nodes = self.atlas.nodes(self.atlas.current)
        if len(nodes) < 2:
            return None
        old, new = min(nodes, key=lambda n: abs(history.frames[n].timestamp - keyframe.timestamp)), nodes[-1]
        if old == new:
            return None
        T_camera_new = se3.inverse(T_tracked) @ history.frames[new].T_world_camera
        T_old_new = se3.inverse(history.frames[old].T_world_camera) @ T_measured @ T_camera_new
        return Edge(old, new, T_old_new, LOOP_NOISE[0] * self.atlas.unit, LOOP_NOISE[1])

    def correct(self, loop: Edge) -> NDArray[np.float64] | None:
        """Optimize the pose graph with a new loop edge and begin to rebuild the map.

        Returns the motion (4, 4) of the newest pose. None if the poses are not finite, or the new pass does not fit the
        map of the old pass (``MAX_RATIO``).
        """
        history = self.atlas.history
        assert history is not None
        nodes = self.atlas.nodes(self.atlas.current)
        index = {n: i for i, n in enumerate(nodes)}
        Ts = np.stack([history.frames[n].T_world_camera for n in nodes])
        edges = _odometry_edges(Ts, self.atlas.unit)
        for edge in (*self.edges, loop):
            if edge.a in index and edge.b in index:
                edges.append(Edge(index[edge.a], index[edge.b], edge.T_a_b, edge.sigma_distance, edge.sigma_angle))
        Ts_new = optimize(Ts, edges)
        if not np.all(np.isfinite(Ts_new)):
            return None
        kept = np.flatnonzero([history.frames[n].count for n in nodes])
        old, new = _passes(Ts_new, kept, index[loop.a], index[loop.b], self.atlas.unit)
        self.atlas.make_room()
        before = self._misfit(self._map_of(nodes, Ts, new), nodes, Ts, new)
        volume = self._map_of(nodes, Ts_new, old)
        if _is_worse(self._misfit(volume, nodes, Ts_new, new), before, self.atlas.unit):
            return None
        history.reintegrate(volume, [nodes[i] for i in new], list(Ts_new[new]))
        self.edges.append(loop)
        return self.atlas.correct(nodes, Ts_new, volume, [nodes[i] for i in (*old, *new)])

    def _map_of(self, nodes: list[int], Ts: NDArray[np.float64], chosen: list[int]) -> TsdfVolume:
        assert self.atlas.history is not None
        volume = self.atlas.make_volume()
        self.atlas.history.reintegrate(volume, [nodes[i] for i in chosen], list(Ts[chosen]))
        return volume

    def _misfit(
        self, volume: TsdfVolume, nodes: list[int], Ts: NDArray[np.float64], chosen: list[int]
    ) -> tuple[float, float]:
        """Mean distance (m) and intensity difference (0..1) of stored frames to a map; infinite without overlap."""
        import cv2

        history = self.atlas.history
        assert history is not None
        camera = self.atlas.keyframes.camera.scaled(2)
        distances, differences, largest = [], [], TRUNCATED_DISTANCE * self.atlas.unit
        for i in chosen:
            stored, T = history[nodes[i]], Ts[i]
            depth = np.where(stored.static, stored.frame.depth, np.float32(0))[1::4, 1::4]
            grey = cv2.cvtColor(stored.frame.rgb, cv2.COLOR_RGB2GRAY)
            size = (depth.shape[1], depth.shape[0])
            intensity = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(255)
            volume.look_at(T)
            sample = volume.sample(np.ascontiguousarray(depth), np.asarray(intensity), camera, T)
            gain, offset = fit_exposure(intensity, sample.difference, np.ones_like(intensity))
            difference = sample.difference + (1 - gain) * intensity - offset
            distances.append(np.minimum(np.abs(sample.distance[np.isfinite(sample.distance)]), largest))
            differences.append(np.abs(difference[np.isfinite(difference)]))
        return _mean(distances), _mean(differences)


def _mean(parts: list[NDArray[np.float32]]) -> float:
    values = np.concatenate(parts)
    return float(values.mean()) if len(values) else np.inf


def _is_worse(after: tuple[float, float], before: tuple[float, float], unit: float) -> bool:
    offsets = MAX_OFFSETS[0] * unit, MAX_OFFSETS[1]
    return any(a > MAX_RATIO * b + offset for a, b, offset in zip(after, before, offsets, strict=True))


def _passes(
    Ts: NDArray[np.float64], kept: NDArray[np.int64], a: int, b: int, unit: float
) -> tuple[list[int], list[int]]:
    """Indices of the ``kept`` poses of a path that view the place of pose ``b``, of the old and the new pass.

    The old pass of the loop ``a`` to ``b`` ends at the farthest point from ``b``.
    """
    farthest = min(max(a + int(np.argmax(view_distances(Ts[a:b], Ts[b], unit))), 1), len(Ts) - 1)
    before, after = kept[kept < farthest], kept[kept >= farthest]
    wanted = max(MAX_IMMEDIATE // 2, MAX_IMMEDIATE - len(before))
    new = after[nearest_views(Ts[after], Ts[b], wanted, unit)]
    old = before[nearest_views(Ts[before], Ts[b], MAX_IMMEDIATE - len(new), unit)]
    return old.tolist(), new.tolist()


def _odometry_edges(Ts: NDArray[np.float64], unit: float) -> list[Edge]:
    """Motions between stored frames; standard deviations (m, rad) grow with their length."""
    motions = se3.inverse(Ts[:-1]) @ Ts[1:]
    sigmas = (ODOMETRY_NOISE[0] + ODOMETRY_NOISE[1] * lengths(motions, unit)).tolist()
    return [Edge(i, i + 1, T, sigma * unit, sigma) for i, (T, sigma) in enumerate(zip(motions, sigmas, strict=True))]


def step_lengths(Ts: NDArray[np.float64], unit: float) -> NDArray[np.float64]:
    """``lengths`` (n - 1,) of the steps along a path (n, 4, 4)."""
    return lengths(se3.inverse(Ts[:-1]) @ Ts[1:], unit)


def lengths(motions: NDArray[np.float64], unit: float) -> NDArray[np.float64]:
    """Lengths (n,) of motions (n, 4, 4) in ``unit`` (m); one radian counts as one."""
    return np.linalg.norm(motions[:, :3, 3], axis=1) / unit + se3.rotation_angles(motions)
