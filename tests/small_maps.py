"""Small maps of a synthetic recording, on the CPU and on a device."""

from dataclasses import replace

from dudmap.config import VolumeConfig
from dudmap.core.backends.device import make_backend
from dudmap.core.map.volume import TsdfVolume
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA

# Focal lengths that no voxel size divides: at the identity, where a map begins, the voxels of a lattice would else
# project exactly onto the borders between pixels, where the last bit of a rounding decides.
CAMERA = replace(DEFAULT_CAMERA.resized(160, 120), fx=129.31, fy=129.13, cx=79.66, cy=59.81)
CONFIG = VolumeConfig(voxel_size=0.03)


def integrated(recording, device, frames=4):
    volume = TsdfVolume(CAMERA, CONFIG, depth_max=6.0, backend=make_backend(device))
    for index in range(frames):
        volume.integrate(recording[index], recording.ground_truth.Ts_world_camera[index])
    return volume


def voxels(volume):
    """Words of all blocks by the coordinates of their block."""
    blocks = volume.blocks
    slots = volume.active_slots
    coords = [tuple(row) for row in blocks.slot_coords[slots]]
    return dict(zip(coords, zip(blocks.geometry[slots], blocks.colors[slots], strict=True), strict=True))
