"""Open3D's dense SLAM (t.pipelines.slam) on frames in a folder; needs only open3d and numpy.

python open3d_slam.py FOLDER VOXEL_SIZE DEPTH_MAX

FOLDER holds depth.npy (N, H, W) uint16, color.npy (N, H, W, 3) uint8 and camera.json with fx, fy, cx, cy and
depth_scale. As Open3D's example dense_slam.py. Prints JSON: version, ms per frame, poses.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np


def main() -> None:
    """Process all frames."""
    import open3d as o3d  # type: ignore[import-not-found]

    folder, voxel_size, depth_max = Path(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3])
    depths, colors = (np.load(folder / f"{kind}.npy", mmap_mode="r", allow_pickle=False) for kind in ("depth", "color"))
    camera = json.loads((folder / "camera.json").read_text(encoding="utf-8"))
    scale, band, nearest, distance = camera["depth_scale"], 8.0, 0.1, 0.07
    device = o3d.core.Device("CPU:0")
    intrinsic = o3d.core.Tensor([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1]])
    height, width = depths.shape[1:]
    T = o3d.core.Tensor(np.eye(4))
    model = o3d.t.pipelines.slam.Model(voxel_size, 16, 40000, T, device)
    seen = o3d.t.pipelines.slam.Frame(height, width, intrinsic, device)
    expected = o3d.t.pipelines.slam.Frame(height, width, intrinsic, device)
    ms, poses = [], []
    for number in range(len(depths)):
        depth = o3d.t.geometry.Image(o3d.core.Tensor(np.array(depths[number])))
        color = o3d.t.geometry.Image(o3d.core.Tensor(np.array(colors[number])))
        start = time.perf_counter()
        seen.set_data_from_image("depth", depth.to(device))
        seen.set_data_from_image("color", color.to(device))
        if number > 0:
            T = T @ model.track_frame_to_model(seen, expected, scale, depth_max, distance).transformation
        model.update_frame_pose(number, T)
        model.integrate(seen, scale, depth_max, band)
        model.synthesize_model_frame(expected, scale, nearest, depth_max, band, False)
        ms.append(1000 * (time.perf_counter() - start))
        poses.append(T.numpy().tolist())
    sys.stdout.write(json.dumps({"version": o3d.__version__, "ms": ms, "poses": poses}) + "\n")


if __name__ == "__main__":
    main()
