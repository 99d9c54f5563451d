"""A small run folder with everything a viewer shows, written without running anything."""

import json

import numpy as np

from dudmap import __version__
from dudmap.app.viewing.snapshot import KINDS, jpeg
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory

FRAMES = 12
CAMERA = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48, "depth_scale": 1000.0}


def wall():
    """Wall at z = 2 m, seen from the front, with a picture of four colours."""
    n = 40
    x, y = np.meshgrid(np.linspace(-1.5, 1.5, n), np.linspace(-1, 1, n), indexing="ij")
    vertices = np.stack([x, y, np.full_like(x, 2.0)], axis=-1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    faces = np.concatenate([
        np.stack([corner, corner + 1, corner + n], axis=1), np.stack([corner + 1, corner + n + 1, corner + n], axis=1),
    ])  # fmt: skip
    colors = np.stack([120 + 100 * np.sign(x), 120 + 100 * np.sign(y), np.full_like(x, 60)], axis=-1)
    normals = np.tile(np.array([0, 0, -1], np.float32), (n * n, 1))
    return Mesh(vertices, faces.astype(np.int32), colors.reshape(-1, 3).astype(np.uint8), normals)


def stamp(k):
    return 100 + 0.1 * k


def write_run(folder, **metrics):
    """Run folder: a camera that moves 5 cm per frame along x before a wall; frame 3 is lost, something moves."""
    folder.mkdir(parents=True)
    lost = {"timestamp": stamp(3), "reason": "too few inliers <b>"}
    tree = {
        "sequence": "desk & <chair>", "complete": True, "stopped_by": None, "frames": FRAMES, "tracked": FRAMES - 1,
        "fused": 9, "skipped_similar": 2, "lost": 1, "unreadable": 1, "ms_per_frame_median": 41.2,
        "dynamic_share_mean": 0.05, "mesh_triangles": len(wall().faces), "lost_frames": [lost],
        "unreadable_frames": ["frame 7: the image is cut off"], "camera": CAMERA | {"distortion": []},
        "versions": {"dudmap": __version__},
    } | metrics  # fmt: skip
    (folder / "metrics.json").write_text(json.dumps(tree))
    (folder / "config.toml").write_text('preset = "default"\n')
    if tree["tracked"]:
        Ts = np.tile(np.eye(4), (FRAMES, 1, 1))
        Ts[:, 0, 3] = 0.05 * np.arange(FRAMES)
        tracked = [(stamp(k), Ts[k]) for k in range(FRAMES) if k != 3]
        Trajectory.from_poses(tracked).save(folder / "trajectory.txt")
    if tree["mesh_triangles"]:
        wall().save(folder / "mesh.ply")
    rows = ["timestamp,state,fused,dynamic_share,reading,total,track,integrate"]
    rows += [f"{stamp(k):.6f},{'lost' if k == 3 else 'tracked'},1,0.05,3,40,25,15" for k in range(FRAMES)]
    (folder / "timings.csv").write_text("\n".join(rows) + "\n")
    box = [[-0.2, -0.4, 1.2], [0.2, 0.6, 1.6]]
    mover = {
        "id": 4,
        "centroid": [0, 0, 1.4],
        "box": box,
        "velocity": [0.5, 0, 0],
        "speed": 0.5,
        "age": 1.0,
        "pixels": 9,
    }
    (folder / "movers.jsonl").write_text(json.dumps({"timestamp": stamp(5), "movers": [mover]}) + "\n")
    edges, counts = np.linspace(0, 8, 33), np.round(1000 * np.exp(-np.arange(32)))
    np.savez(folder / "residuals.npz", edges=edges, counts=counts, prior=[0.9, 0.1], sigma=[0.5, 3.0])
    kept = np.tile(np.eye(4), (2, 1, 1))
    kept[:, 0, 3] = -0.4, 0.9
    np.savez(
        folder / "keyframes.npz", format="dudmap keyframes 1", voxel_size=0.01, timestamps=[stamp(0), stamp(8)],
        Ts_world_camera=kept, counts=[1, 1], points=np.ones((2, 3), np.float32),
        descriptors=np.zeros((2, 128), np.float16), residuals=np.zeros(0), shares=np.zeros(0), colors=np.zeros(0),
    )  # fmt: skip
    (folder / "thumbnails").mkdir()
    for k in range(0, FRAMES, 4):
        for number, kind in enumerate(KINDS):
            image = np.full((48, 64, 3), 40 * number + k, np.uint8)
            (folder / "thumbnails" / f"{stamp(k):.6f}.{kind}.jpg").write_bytes(jpeg(image))
    return folder
