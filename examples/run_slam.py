"""Track and map a recording with a walking person, and render the map."""

import sys
from pathlib import Path

import cv2

from dudmap import Camera, Slam
from dudmap.lab import synthetic

out = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
camera = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
sequence = synthetic.sequence("room", movers=("person",), frames=12, camera=camera)
slam = Slam(sequence.camera)
for index in range(len(sequence)):
    result = slam.process(sequence[index])
    print(f"{result.timestamp:.3f} s: {result.status}, {result.dynamic_share:.0%} of the measurements are dynamic")
slam.trajectory.save(out / "trajectory.txt")
slam.volume.extract_mesh().save(out / "mesh.ply")
view = slam.volume.raycast(slam.trajectory.Ts_world_camera[0])  # the artificial camera view of the thesis
cv2.imwrite(str(out / "view.png"), view.color[..., ::-1])
