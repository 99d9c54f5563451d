"""Render the map from a new pose (artificial camera view of the thesis)."""

import numpy as np

from dudmap import Camera, TsdfVolume
from dudmap.lab import synthetic

camera = Camera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120)
sequence = synthetic.sequence("room", movers=(), frames=6, camera=camera)
volume = TsdfVolume(camera)
for index in range(len(sequence)):
    volume.integrate(sequence[index], sequence.ground_truth.Ts_world_camera[index])
T_world_camera = sequence.ground_truth.Ts_world_camera[0].copy()
T_world_camera[:3, 3] -= 0.2 * T_world_camera[:3, 2]  # 20 cm behind the first camera
view = volume.raycast(T_world_camera, camera.resized(320, 240))  # color, depth, normals
print(
    f"surface in {np.mean(view.depth > 0):.0%} of the view, median depth {np.median(view.depth[view.depth > 0]):.2f} m"
)
