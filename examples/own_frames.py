"""Process images of your own: depth in metres and colour of the same size, as NumPy arrays."""

import numpy as np

from dudmap import Camera, Slam

camera = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
slam = Slam(camera)
v, u = np.mgrid[:240, :320]
for number in range(5):
    z = 1.5 + 0.2 * np.sin(u / 20) * np.cos(v / 25)  # a wavy wall in front of a fixed camera
    shade = 128 + 60 * np.sin(u / 7) * np.sin(v / 9)
    rgb = np.repeat(shade[..., None], 3, axis=2).astype(np.uint8)
    result = slam.process(depth=z.astype(np.float32), rgb=rgb, timestamp=number / 30)
    print(result.timestamp, result.status, "fused" if result.fused else "redundant")
