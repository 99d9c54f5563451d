"""Correction of a submap after a loop closure: pose graph optimization and the map built from its poses."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dudmap.geometry import se3
from dudmap.mapping.volume import TsdfVolume
from dudmap.places.atlas import Atlas
from dudmap.places.place_recognition import Keyframe
from dudmap.places.pose_graph import Edge, optimize

COMPARED_FRAMES = 12
"""Stored frames, evenly spread over the submap, by which the corrected map is compared with the old one."""
MAX_DISTANCE_RATIO, MAX_DISTANCE_OFFSET = 1.15, 0.0005
MAX_INTENSITY_RATIO, MAX_INTENSITY_OFFSET = 1.5, 0.002
"""A correction is rejected if the mean misfit of the frames exceeds ratio times the old one plus offset (m; 0..1).

In the old map the two passes of a loop lie apart and each fits its own; in the corrected one they must share a surface
and a texture. Behind a lens whose focal length is believed 2.2 % too long, where no trajectory is fully consistent,
the right correction raises the distances by up to 6 % and the intensity differences by 30 %. With an error of 2
degrees and 5 cm it raises them by 7 to 25 % and 42 to 50 %, with 15 degrees and 40 cm by 29 to 36 % and 65 to 120 %:
the comparison finds gross errors only, smaller ones are left to the verification.
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
        """Optimize the pose graph with a new loop edge and rebuild the map from the corrected poses.

        The correction is applied to the atlas, and the edge stored, only if the poses are finite and the stored frames
        fit the corrected map about as well as the old one.

        Returns:
            (4, 4) motion of the newest pose, None if the correction was rejected.
        """
        history = self.atlas.history
        assert history is not None
        nodes = self.atlas.nodes(self.atlas.current)
        index = {n: i for i, n in enumerate(nodes)}
        Ts = np.stack([history.Ts_world_camera[n] for n in nodes])
        edges = [_odometry_edge(i, Ts) for i in range(len(nodes) - 1)]
        for edge in (*self.edges, loop):
            if edge.a in index and edge.b in index:
                edges.append(Edge(index[edge.a], index[edge.b], edge.T_a_b, edge.sigma_distance, edge.sigma_angle))
        Ts_new = optimize(Ts, edges)
        if not np.all(np.isfinite(Ts_new)):
            return None
        self.atlas.volume.page_out()  # two maps need not fit into the memory
        volume = self.atlas.make_volume()
        history.reintegrate(volume, nodes, list(Ts_new))
        volume.page_out()
        if self._fits_worse(volume, nodes, Ts, Ts_new):
            return None
        self.edges.append(loop)
        return self.atlas.correct(nodes, Ts_new, volume)

    def _fits_worse(
        self, volume: TsdfVolume, nodes: list[int], Ts: NDArray[np.float64], Ts_new: NDArray[np.float64]
    ) -> bool:
        """Whether the stored frames fit the corrected map clearly worse than the old one, in distance or intensity."""
        chosen = np.unique(np.linspace(0, len(nodes) - 1, COMPARED_FRAMES).round().astype(int))
        before = self._misfit(self.atlas.volume, [nodes[i] for i in chosen], Ts[chosen])
        self.atlas.volume.page_out()
        after = self._misfit(volume, [nodes[i] for i in chosen], Ts_new[chosen])
        return bool(
            after[0] > MAX_DISTANCE_RATIO * before[0] + MAX_DISTANCE_OFFSET
            or after[1] > MAX_INTENSITY_RATIO * before[1] + MAX_INTENSITY_OFFSET
        )

    def _misfit(self, volume: TsdfVolume, nodes: list[int], Ts: NDArray[np.float64]) -> tuple[float, float]:
        """Mean distance (m) and mean intensity difference (0..1) of stored frames to a map at poses (n, 4, 4)."""
        import cv2

        history = self.atlas.history
        assert history is not None
        camera = self.atlas.keyframes.camera.scaled(2)
        distances, differences = [], []
        for n, T in zip(nodes, Ts, strict=True):
            stored = history[n]
            depth = np.where(stored.static, stored.frame.depth, np.float32(0))[1::4, 1::4]
            grey = cv2.cvtColor(stored.frame.color, cv2.COLOR_RGB2GRAY)
            size = (depth.shape[1], depth.shape[0])
            intensity = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(255)
            volume.look_at(T)
            sample = volume.sample(np.ascontiguousarray(depth), np.asarray(intensity), camera, T)
            on_map = np.isfinite(sample.distance)
            distances.append(np.minimum(np.abs(sample.distance[on_map]), TRUNCATED_DISTANCE))
            differences.append(np.abs(sample.difference[on_map]))
        return float(np.concatenate(distances).mean()), float(np.concatenate(differences).mean())


def _odometry_edge(i: int, Ts: NDArray[np.float64]) -> Edge:
    """Tracked motion from one stored frame to the next; its standard deviation grows with its length."""
    sigma = ODOMETRY_NOISE[0] + ODOMETRY_NOISE[1] * path_length([Ts[i], Ts[i + 1]])
    return Edge(i, i + 1, se3.inverse(Ts[i]) @ Ts[i + 1], sigma, sigma)


def path_length(Ts: list[NDArray[np.float64]]) -> float:
    """Length of a path in metres; a turn by one radian counts as one metre."""
    steps = [se3.inverse(a) @ b for a, b in pairwise(Ts)]
    return float(sum(np.linalg.norm(step[:3, 3]) + se3.rotation_angle(step) for step in steps))
