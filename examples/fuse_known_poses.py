"""Fuse frames at known poses, without tracking."""

import sys

from dudmap import TsdfVolume
from dudmap.lab import synthetic

out = sys.argv[1] if len(sys.argv) > 1 else "fused.ply"
sequence = synthetic.sequence("room", movers=(), frames=8)
volume = TsdfVolume(sequence.camera)
for index in range(len(sequence)):
    volume.integrate(sequence[index], sequence.ground_truth.Ts_world_camera[index])
mesh = volume.extract_mesh()
mesh.save(out)
print(f"{len(mesh.faces)} triangles, {mesh.area():.1f} m^2, {volume.num_bytes / 1e6:.0f} MB of map -> {out}")
