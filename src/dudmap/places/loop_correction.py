"""Correction of a submap after a loop closure: pose graph optimization and the map built from its poses."""

import numpy as np
from numpy.typing import NDArray

from dudmap.geometry import se3
from dudmap.mapping.volume import TsdfVolume
from dudmap.places.atlas import Atlas
from dudmap.places.map_rebuilding import AT_ONCE, nearest_views
from dudmap.places.place_recognition import Keyframe
from dudmap.places.pose_graph import Edge, optimize

COMPARED_FRAMES = 12
"""Stored frames, evenly spread over those around the loop, by which the corrected map is compared with the old one."""
MAX_DISTANCE_INCREASE, MAX_INTENSITY_INCREASE = 0.0005, 0.004
"""A correction is rejected if the mean misfit of the frames grows by more than this, metres and intensity (0..1).

At the old poses the two passes of a loop lie apart; the right correction brings them together, so that the distances
fall. Behind a lens whose focal length is believed 2.2 % too long, where no trajectory is fully consistent, they fall
by 11 % of 16 mm, and the intensity differences by 25 % of 0.027; in a corridor of 40 m the distances fall by 6 to 7 %
of 14 mm, and the intensity differences grow by 0.0002 to 0.0014. With an error of 1 degree and 2 cm behind that lens
the distances fall by 3 to 5 %; with 2 degrees and 5 cm they change by -4 to 4 %, with 15 degrees and 40 cm they grow
by 6 to 16 %: the comparison finds gross errors only, smaller ones are left to the verification.
"""
TRUNCATED_DISTANCE = 0.05
"""Distances to the map are truncated at this value in that comparison, metres."""
ODOMETRY_NOISE = 0.002, 0.02
"""Standard deviation of a tracked motion: metres (or radians), and per metre of its path."""
LOOP_NOISE = 0.005, 0.003
"""Standard deviation of a motion measured at a loop closure: metres and radians."""


class LoopCorrector:
    """Distributes the drift measured by loop closures over the stored frames of the current submap.

    Args:
        atlas: The submaps; its frame store must exist.

    Attributes:
        edges: Motions measured by the loop closures so far, between numbers of stored frames.
    """

    def __init__(self, atlas: Atlas) -> None:
        self.atlas = atlas
        self.edges: list[Edge] = []

    def measured_edge(
        self, keyframe: Keyframe, T_tracked: NDArray[np.float64], T_measured: NDArray[np.float64]
    ) -> Edge | None:
        """Motion from the stored frame nearest in time to a keyframe to the newest stored frame.

        Args:
            keyframe: Keyframe of the current submap that was recognised.
            T_tracked: (4, 4) tracked pose of the frame that recognised it.
            T_measured: (4, 4) pose of that frame relative to the map at the time of the keyframe.

        Returns:
            None if both are the same stored frame.
        """
        history = self.atlas.history
        assert history is not None
        nodes = self.atlas.nodes(self.atlas.current)
        if len(nodes) < 2:
            return None
        timestamps = np.array([history.timestamps[n] for n in nodes])
        old, new = nodes[int(np.argmin(np.abs(timestamps - keyframe.timestamp)))], nodes[-1]
        if old == new:
            return None
        T_camera_new = se3.inverse(T_tracked) @ history.Ts_world_camera[new]
        T_old_new = se3.inverse(history.Ts_world_camera[old]) @ T_measured @ T_camera_new
        return Edge(old, new, T_old_new, *LOOP_NOISE)

    def correct(self, loop: Edge) -> NDArray[np.float64] | None:
        """Optimize the pose graph with a new loop edge and begin to rebuild the map from the corrected poses.

        The correction is applied to the atlas, and the edge stored, only if the poses are finite and the stored frames
        around the loop, where both passes meet, fit a map of them at the corrected poses about as well as one at the
        old poses.

        Returns:
            (4, 4) motion of the newest pose, None if the correction was rejected.
        """
        history = self.atlas.history
        assert history is not None
        nodes = self.atlas.nodes(self.atlas.current)
        index = {n: i for i, n in enumerate(nodes)}
        Ts = np.stack([history.Ts_world_camera[n] for n in nodes])
        edges = _odometry_edges(Ts)
        for edge in (*self.edges, loop):
            if edge.a in index and edge.b in index:
                edges.append(Edge(index[edge.a], index[edge.b], edge.T_a_b, edge.sigma_distance, edge.sigma_angle))
        Ts_new = optimize(Ts, edges)
        if not np.all(np.isfinite(Ts_new)):
            return None
        near = nearest_views(history, nodes, Ts[-1], AT_ONCE)
        chosen = [index[n] for n in near]
        self.atlas.make_room()
        before = self._misfit(self._map_of(near, Ts[chosen]), near, Ts[chosen])
        volume = self._map_of(near, Ts_new[chosen])
        after = self._misfit(volume, near, Ts_new[chosen])
        if _is_worse(after, before):
            return None
        self.edges.append(loop)
        return self.atlas.correct(nodes, Ts_new, volume, near)

    def _map_of(self, nodes: list[int], Ts: NDArray[np.float64]) -> TsdfVolume:
        """Map of stored frames at poses (n, 4, 4)."""
        assert self.atlas.history is not None
        volume = self.atlas.make_volume()
        self.atlas.history.reintegrate(volume, nodes, list(Ts))
        return volume

    def _misfit(self, volume: TsdfVolume, nodes: list[int], Ts: NDArray[np.float64]) -> tuple[float, float]:
        """Mean distance (m) and mean intensity difference (0..1) of some of the stored frames to a map at poses (n, 4,
        4)."""
        import cv2

        history = self.atlas.history
        assert history is not None
        camera = self.atlas.keyframes.camera.scaled(2)
        distances, differences = [], []
        for i in np.unique(np.linspace(0, len(nodes) - 1, COMPARED_FRAMES).round().astype(int)):
            stored, T = history[nodes[i]], Ts[i]
            depth = np.where(stored.static, stored.frame.depth, np.float32(0))[1::4, 1::4]
            grey = cv2.cvtColor(stored.frame.color, cv2.COLOR_RGB2GRAY)
            size = (depth.shape[1], depth.shape[0])
            intensity = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(255)
            volume.look_at(T)
            sample = volume.sample(np.ascontiguousarray(depth), np.asarray(intensity), camera, T)
            on_map = np.isfinite(sample.distance)
            distances.append(np.minimum(np.abs(sample.distance[on_map]), TRUNCATED_DISTANCE))
            differences.append(np.abs(sample.difference[np.isfinite(sample.difference)]))
        return float(np.concatenate(distances).mean()), float(np.concatenate(differences).mean())


def _is_worse(after: tuple[float, float], before: tuple[float, float]) -> bool:
    """Whether frames fit the corrected map clearly worse than the old one, in distance or intensity."""
    return after[0] - before[0] > MAX_DISTANCE_INCREASE or after[1] - before[1] > MAX_INTENSITY_INCREASE


def _odometry_edges(Ts: NDArray[np.float64]) -> list[Edge]:
    """Tracked motion from each stored frame (n, 4, 4) to the next; its standard deviation grows with its length."""
    sigmas = (ODOMETRY_NOISE[0] + ODOMETRY_NOISE[1] * step_lengths(Ts)).tolist()
    motions = se3.inverse(Ts[:-1]) @ Ts[1:]
    return [Edge(i, i + 1, T, sigma, sigma) for i, (T, sigma) in enumerate(zip(motions, sigmas, strict=True))]


def step_lengths(Ts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths (n - 1,) of the steps along a path (n, 4, 4), metres; a turn by one radian counts as one metre."""
    steps = se3.inverse(Ts[:-1]) @ Ts[1:]
    R = steps[:, :3, :3]
    twice_sine = np.linalg.norm(R[:, [2, 0, 1], [1, 2, 0]] - R[:, [1, 2, 0], [2, 0, 1]], axis=1)
    return np.linalg.norm(steps[:, :3, 3], axis=1) + np.arctan2(twice_sine, np.trace(R, axis1=1, axis2=2) - 1)
