"""Writers of the folders that phones, cameras and their programs leave, without the readers' code."""

import json

import cv2
import numpy as np

from layout_images import Layout, color, exr, millimetres, open3d_camera, pose, write_color, write_depth


def nerfstudio(folder):
    frames = []
    for k in (2, 0, 1):  # order of the file does not matter
        write_color(folder / f"images/frame_{9 + k}.jpg", k, 128, 96)
        write_depth(folder / f"depth/frame_{9 + k}.png", k)
        T = pose(k) @ np.diag([1.0, -1.0, -1.0, 1.0])
        T[:3, 3] *= 2.0  # nerfstudio's applied_scale
        frames.append(
            {
                "file_path": f"images/frame_{9 + k}.jpg",
                "depth_file_path": f"depth/frame_{9 + k}.png",
                "transform_matrix": T.tolist(),
            }
        )
    tree = {
        "camera_model": "OPENCV", "fl_x": 120.0, "fl_y": 122.0, "cx": 62.5, "cy": 46.5, "w": 128, "h": 96,
        "applied_scale": 2.0, "frames": frames,
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(tree))
    # halves of 2x2 pixels: centre (c + 0.5) / 2 - 0.5
    return Layout("nerfstudio", (60, 61, 31, 23), color=(120, 122, 62.5, 46.5, (96, 128)))


def write_confidence(path, levels):
    """All readings are trusted but those that ``millimetres`` leaves out."""
    path.parent.mkdir(parents=True, exist_ok=True)
    confidence = np.full((48, 64), levels[1], np.uint8)
    confidence[24:] = levels[2]
    confidence[:5, :7] = levels[0]
    assert cv2.imwrite(str(path), confidence)


def stray_scanner(folder):
    """As OdometryEncoder, DepthEncoder, ConfidenceEncoder and DatasetEncoder of the application write it."""
    video = cv2.VideoWriter(str(folder / "rgb.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 60, (128, 96))
    odometry = "timestamp, frame, x, y, z, qx, qy, qz, qw\n"
    for k in range(3):
        video.write(color(k, 128, 96)[..., ::-1])
        write_depth(folder / f"depth/{k:06d}.png", k, missing=900)
        write_confidence(folder / f"confidence/{k:06d}.png", (0, 1, 2))
        odometry += f"{9052.25 + k / 60}, {k:06d}, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0\n"
    video.release()
    (folder / "odometry.csv").write_text(odometry)
    (folder / "imu.csv").write_text("timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n")
    (folder / "camera_matrix.csv").write_text("120.0, 0.0, 62.5\n0.0, 122.0, 46.5\n0.0, 0.0, 1.0")
    stamps = [9052.25 + k / 60 for k in range(3)]
    return Layout("Stray Scanner", (60, 61, 31, 23), stamps=stamps, truth=None, color=(120, 122, 62.5, 46.5, (96, 128)))


def arkit_scenes(folder):
    """As download_data.py of ARKitScenes unpacks it; not every image of a kind has one of the other kind."""
    trajectory = ""
    for k in range(4):
        name = f"41069021_{305.377 + 0.1 * k:.3f}"
        write_color(folder / f"lowres_wide/{name}.png", k)
        if k < 3:
            write_depth(folder / f"lowres_depth/{name}.png", k, missing=900)
            write_confidence(folder / f"confidence/{name}.png", (0, 1, 2))
            T = np.linalg.inv(pose(k))  # of points of the world into the camera
            numbers = [305.377 + 0.1 * k, *cv2.Rodrigues(T[:3, :3])[0].ravel(), *T[:3, 3]]
            trajectory += " ".join(f"{number:.9f}" for number in numbers) + "\n"
        pincam = folder / f"lowres_wide_intrinsics/{name}.pincam"
        pincam.parent.mkdir(exist_ok=True)
        pincam.write_text(f"64 48 {59 + min(k, 2)} {60 + min(k, 2)} 31 23")
    (folder / "lowres_wide.traj").write_text(trajectory)
    stamps = [305.377 + 0.1 * k for k in range(3)]
    return Layout("ARKitScenes", (60.5, 61.5, 31, 23), stamps=stamps, name="41069021")


def polycam(folder):
    """As the application exports it after its optimisation of the poses."""
    for k in range(3):
        name = f"keyframes/{{}}/{82_000_000 + 250_000 * k}"
        for kind, shift in (("", 9), ("corrected_", 0)):
            write_color(folder / f"{name.format(kind + 'images')}.jpg", k, 128, 96)
            T = pose(k) @ np.diag([1.0, -1.0, -1.0, 1.0])
            tree = {f"t_{i}{j}": T[i, j] + shift * (j == 3) for i in range(3) for j in range(4)}
            tree |= {
                "fx": 120.0 + k - 1 + shift,
                "fy": 122.0 + k - 1,
                "cx": 62.5,
                "cy": 46.5,
                "width": 128,
                "height": 96,
            }
            file = folder / f"{name.format(kind + 'cameras')}.json"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(tree | {"blur_score": 71.5, "timestamp": 82_000_000 + 250_000 * k}))
        write_depth(folder / f"{name.format('depth')}.png", k, missing=900)
        write_confidence(folder / f"{name.format('confidence')}.png", (0, 127, 255))
    (folder / "mesh_info.json").write_text(json.dumps({"faceCount": 0, "alignmentTransform": [0.0] * 16}))
    stamps = [82 + 0.25 * k for k in range(3)]
    return Layout("Polycam", (60, 61, 31, 23), stamps=stamps, color=(120, 122, 62.5, 46.5, (96, 128)))


def record3d(folder):
    """As the application exports "EXR + JPG sequence"; some of the frames were deleted."""
    (folder / "depth").mkdir()
    for number, k in ((0, 0), (1, 1), (3, 2)):
        write_color(folder / f"rgb/{number}.jpg", k, 128, 96)
        (folder / f"depth/{number}.exr").write_bytes(exr({"R": (millimetres(k) / 1000).astype(np.float32)}))
    tree = {
        "w": 128, "h": 96, "dw": 64, "dh": 48, "fps": 60, "cameraType": 1, "initPose": [0, 0, 0, 1, 0, 0, 0],
        "K": [120.0, 0, 0, 0, 122.0, 0, 62.5, 46.5, 1], "frameTimestamps": [0, 0.0167, 0.0334, 0.05],
        "poses": [[0, 0, 0, 1, 0, 0, 0]] * 4,
    }  # fmt: skip
    (folder / "metadata.json").write_text(json.dumps(tree))
    other = (120, 122, 62.5, 46.5, (96, 128))
    return Layout("Record3D images", (60, 61, 31, 23), stamps=[0, 0.0167, 0.05], truth=None, color=other)


def suffixed(folder):
    """Names of depth images are those of the colour images and a word, as in RGB-D Scenes of Washington."""
    for k in range(3):
        write_color(folder / f"desk_1_{k}.png", k)
        write_depth(folder / f"desk_1_{k}_depth.png", k)
        write_color(folder / f"desk_1_{k}_mask.png", k + 1)
    (folder / "camera_intrinsic.json").write_text(open3d_camera())
    return Layout("numbered images", (60, 61, 31, 23), truth=None)


def realsense(folder):
    """As Open3D's realsense_recorder writes it: depth aligned to colour."""
    for k in range(3):
        write_color(folder / f"color/{k:06d}.jpg", k)
        write_depth(folder / f"depth/{k:06d}.png", k)
    (folder / "camera_intrinsic.json").write_text(open3d_camera())
    return Layout("numbered images", (60, 61, 31, 23), truth=None)


def azure_kinect(folder):
    """As Open3D's azure_kinect_mkv_reader writes it."""
    for k in range(3):
        write_color(folder / f"color/{k:05d}.jpg", k)
        write_depth(folder / f"depth/{k:05d}.png", k)
    (folder / "intrinsic.json").write_text(
        open3d_camera(serial_number_="000123", color_mode="MJPG_720P", depth_mode="NFOV_UNBINNED", stream_length_usec=1)
    )
    return Layout("numbered images", (60, 61, 31, 23), truth=None)


def zed(folder):
    """As the ZED SDK's sample of SVO export writes it, with intrinsics of its calibration as JSON."""
    for k in range(3):
        write_color(folder / f"left{k:06d}.png", k)
        write_color(folder / f"right{k:06d}.png", k + 1)
        write_depth(folder / f"depth{k:06d}.png", k)
    cameras = {side: {"fx": 60.0 + n, "fy": 61.0, "cx": 31.0, "cy": 23.0} for n, side in enumerate(("left", "right"))}
    tree = {"calibration_parameters": {f"{side}_cam": values for side, values in cameras.items()}}
    (folder / "calibration.json").write_text(json.dumps(tree))
    return Layout("numbered images", (60, 61, 31, 23), truth=None)


def timed(folder):
    """Two cameras, names are times in microseconds."""
    for k in range(3):
        write_color(folder / f"rgb/{1_700_000_000_000_000 + 100_000 * k}.png", k, 96, 72)
        write_depth(folder / f"depth/{1_700_000_000_004_000 + 100_000 * k}.png", k)
    lens = [0.0] * 5
    camera = {"fx": 60.0, "fy": 61.0, "ppx": 31.0, "ppy": 23.0, "width": 64, "height": 48, "coeffs": lens}
    other = {"fx": 88.0, "fy": 89.0, "ppx": 47.0, "ppy": 35.0, "width": 96, "height": 72, "coeffs": lens}
    T = np.eye(4)
    T[:3, 3] = [0.015, 0, 0]
    tree = {"depth": camera, "color": other, "depth_scale": 0.001, "depth_to_color": T.tolist()}
    (folder / "camera.json").write_text(json.dumps(tree))
    return Layout(
        "numbered images", (60, 61, 31, 23), stamps=[1.7e9 + 0.004 + 0.1 * k for k in range(3)], truth=None,
        color=(88, 89, 47, 35, (72, 96)), T_color_depth=T,
    )  # fmt: skip
