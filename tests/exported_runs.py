"""A small run folder made from true poses, and its recording."""

from pathlib import Path

from dudmap.app.pipeline.run_folder import save_mask
from dudmap.config import VolumeConfig
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.map.volume import TsdfVolume
from dudmap.lab import synthetic
from dudmap.lab.synthetic.folder import write_folder

CAMERA = Camera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120, depth_scale=5000.0)
VOXEL = 0.02


def make_run(where: Path, frames: int = 8, movers: tuple[str, ...] = ("person",)):
    """Run folder ``where/run`` and recording ``where/recording``; the sequence, and the world of its truth in the
    map's."""
    sequence = synthetic.sequence(
        scene="room", movers=list(movers), camera_path="orbit", frames=frames, fps=6, noise="none", camera=CAMERA
    )
    T_map_true = se3.inverse(sequence.ground_truth.Ts_world_camera[0])
    Ts = T_map_true @ sequence.ground_truth.Ts_world_camera
    volume = TsdfVolume(CAMERA, VolumeConfig(voxel_size=VOXEL))
    (where / "run" / "masks").mkdir(parents=True)
    for index in range(frames):
        frame, mask = sequence[index], sequence.mask(index)
        volume.integrate(frame, Ts[index], ~mask, count=10)
        save_mask(where / "run" / "masks" / f"{frame.timestamp:.6f}.png", mask)
    volume.save(where / "run" / "map.npz")
    volume.extract_mesh().save(where / "run" / "mesh.ply")
    Trajectory(sequence.timestamps, Ts).save(where / "run" / "trajectory.txt")
    write_folder(sequence, where / "recording", surface=False)
    return sequence, T_map_true
