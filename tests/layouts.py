"""Writers of every folder layout that is read, after the data sets' descriptions, without the readers' code."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np

from device_layouts import (
    arkit_scenes,
    azure_kinect,
    nerfstudio,
    polycam,
    realsense,
    record3d,
    stray_scanner,
    suffixed,
    timed,
    zed,
)
from layout_images import (
    Layout,
    millimetres,
    open3d_camera,
    pose,
    rows,
    tum_line,
    write_color,
    write_depth,
)


def tum(folder):
    lines = {"rgb": "", "depth": "", "groundtruth": "# timestamp tx ty tz qx qy qz qw\n"}
    for k in range(3):
        stamp = 100 + 0.1 * k
        write_color(folder / f"rgb/{stamp:.6f}.png", k)
        write_depth(folder / f"depth/{stamp:.6f}.png", k, 5000)
        lines["rgb"] += f"{stamp:.6f} rgb/{stamp:.6f}.png\n"
        lines["depth"] += f"{stamp:.6f} depth/{stamp:.6f}.png\n"
        lines["groundtruth"] += tum_line(f"{stamp:.4f}", pose(k))
    for name, text in lines.items():
        (folder / f"{name}.txt").write_text(text)
    (folder / "intrinsics.txt").write_text("fx 60\nfy 61\ncx 31\ncy 23\n")
    return Layout("TUM RGB-D", (60, 61, 31, 23), stamps=[100, 100.1, 100.2])


def bonn(folder):
    tum(folder)
    (folder / "intrinsics.txt").unlink()
    for path in (*folder.glob("rgb/*"), *folder.glob("depth/*")):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), cv2.resize(image, (640, 480), interpolation=cv2.INTER_NEAREST))
    # truth of the page: camera = T_ROS^-1 marker T_ROS T_m, hence marker = T_ROS camera T_m^-1 T_ROS
    ros = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    mount = np.eye(4)
    U, _, Vt = np.linalg.svd([[1.0157, 0.1828, -0.2389], [0.0009, -0.8431, -0.6413], [-0.3009, 0.6147, -0.8085]])
    mount[:3, :3], mount[:3, 3] = U @ Vt, [0.0113, -0.0098, 0.0111]
    text = ""
    for k in range(3):
        marker = ros @ pose(k) @ np.linalg.inv(mount) @ np.linalg.inv(ros)
        R, t = marker[:3, :3], marker[:3, 3]
        text += f"{100 + 0.1 * k:.4f} " + " ".join(f"{v:.9f}" for v in [*t, *quaternion(R)]) + "\n"
    (folder / "groundtruth.txt").write_text(text)
    intrinsics = (542.822841, 542.576870, 315.593520, 237.756098)
    return Layout("Bonn RGB-D Dynamic", intrinsics, (480, 640), [100, 100.1, 100.2], numbers=[], name="rgbd_bonn_test")


def quaternion(R):
    """xyzw of any rotation, by its axis and angle."""
    vector = cv2.Rodrigues(R)[0].ravel()
    angle = np.linalg.norm(vector)
    return [*(vector / angle * np.sin(angle / 2)), np.cos(angle / 2)]


def mirrored(T):
    """A pose in the left-handed axes of ICL-NUIM, y up."""
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    return flip @ T @ flip


def icl_nuim(folder):
    pairs = ""
    for k in range(3):
        write_color(folder / f"rgb/{k}.png", k, 640, 480)
        write_depth(folder / f"depth/{k}.png", k, 5000, 640, 480)
        pairs += f"{k} depth/{k}.png {k} rgb/{k}.png\n"
    (folder / "associations.txt").write_text(pairs)
    truth = "".join(tum_line(k, mirrored(pose(k))) for k in (1, 2))
    (folder / "livingRoom2.gt.freiburg").write_text(truth)
    return Layout(
        "ICL-NUIM", (481.2, 480, 319.5, 239.5), (480, 640), truth=[pose(1), pose(2)], name="living_room_traj2_frei_png"
    )


def icl_nuim_loop(folder):
    x, y = np.meshgrid((np.arange(640) - 319.5) / 481.2, (np.arange(480) - 239.5) / -480.0)
    for k in range(3):
        write_color(folder / f"scene_00_{k:04d}.png", k, 640, 480)
        distance = millimetres(k, 640, 480) / 1000 * np.sqrt(x * x + y * y + 1)
        np.savetxt(folder / f"scene_00_{k:04d}.depth", distance, fmt="%.6f")
        T = mirrored(pose(k))
        keys = {"cam_pos": T[:3, 3], "cam_dir": 1.5 * T[:3, 2], "cam_up": T[:3, 1], "cam_right": 1.33 * T[:3, 0]}
        text = "".join(f"{key:12} = [{', '.join(f'{v:.9f}' for v in vector)}]';\n" for key, vector in keys.items())
        (folder / f"scene_00_{k:04d}.txt").write_text(text + "cam_angle    = 90;\n")
    return Layout("ICL-NUIM", (481.2, 480, 319.5, 239.5), (480, 640))


def corbs(folder):
    lines = {"rgb": "", "depth": ""}
    for k in range(3):
        stamp = f"{1447.5 + 0.1 * k:.6f}"
        write_color(folder / f"rgb/{stamp}.png", k, 640, 480)
        write_depth(folder / f"depth/{stamp}.png", k, 5000, 640, 480)
        for kind in lines:
            lines[kind] += f"{stamp} {kind}\\{stamp}.png\n"
    for kind, text in lines.items():
        (folder / f"{kind}.txt").write_text(text)
    (folder / "groundtruth.txt").write_text("".join(tum_line(1447.5 + 0.1 * k, pose(k)) for k in range(3)))
    camera = (468.60, 468.61, 318.27, 243.99)
    return Layout("CoRBS", camera, (480, 640), [1447.5, 1447.6, 1447.7], name="D1_pre_registereddata")


def seven_scenes(folder):
    for k in range(3):
        write_color(folder / f"frame-{k:06d}.color.png", k, 640, 480)
        write_depth(folder / f"frame-{k:06d}.depth.png", k, width=640, height=480, missing=65535)
        (folder / f"frame-{k:06d}.pose.txt").write_text(rows(pose(k)).replace(" ", "\t "))
    T = np.eye(4)
    T[:3, :3] = [
        [0.99996518012567637, 0.0026765126468950343, -0.0079041012313000904],
        [-0.00274093112813167, 0.99996302803027592, -0.0081504520778013286],
        [0.0078819942130445332, 0.0081718328771890631, 0.99993554558014031],
    ]
    T[:3, 3] = [-0.025558943178152542, 0.00010109636268061706, 0.0020318321729487039]
    return Layout(
        "7-Scenes",
        (585, 585, 320, 240),
        (480, 640),
        name="7-scenes-chess",
        color=(525, 525, 320, 240, (480, 640)),
        T_color_depth=T,
    )


def tsdf_fusion(folder):
    """The sample of andyzeng/tsdf-fusion: registered images and one matrix."""
    for k in range(3):
        write_color(folder / f"frame-{15 + 2 * k:06d}.color.png", k)
        write_depth(folder / f"frame-{15 + 2 * k:06d}.depth.png", k, missing=65535)
        (folder / f"frame-{15 + 2 * k:06d}.pose.txt").write_text(rows(pose(k)))
    (folder / "intrinsics.K.txt").write_text("60.0 0 31.0\n0 61.0 23.0\n0 0 1\n")
    return Layout("3DMatch or tsdf-fusion", (60, 61, 31, 23), stamps=[15 / 30, 17 / 30, 19 / 30])


def with_matrices(folder):
    """images/, depth/, K.txt and poses.txt with a matrix a line, of a HoloLens for example."""
    for k in range(3):
        write_color(folder / f"images/{k}.jpg", k)
        write_depth(folder / f"depth/{k}.png", k)
    (folder / "K.txt").write_text("60.0 0 31.0\n0 61.0 23.0\n0 0 1\n")
    (folder / "poses.txt").write_text("".join(" ".join(f"{v:.9f}" for v in pose(k).ravel()) + "\n" for k in range(3)))
    return Layout("numbered images", (60, 61, 31, 23))


def bop(folder):
    """As docs/bop_datasets_format.md of bop_toolkit has it: depth in tenths of a millimetre, poses world to camera."""
    cameras = {}
    for k in range(3):
        write_color(folder / f"rgb/{k:06d}.png", k)
        write_depth(folder / f"depth/{k:06d}.png", k, 10000.0)
        T = np.linalg.inv(pose(k))
        cameras[str(k)] = {
            "cam_K": [60.0, 0.0, 31.0, 0.0, 61.0, 23.0, 0.0, 0.0, 1.0], "depth_scale": 0.1,
            "cam_R_w2c": T[:3, :3].ravel().tolist(), "cam_t_w2c": (1000 * T[:3, 3]).tolist(),
        }  # fmt: skip
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    (folder / "scene_gt.json").write_text("{}")
    return Layout("BOP", (60, 61, 31, 23))


def volume_deform(folder):
    for k in range(3):
        write_color(folder / f"data/frame-{k:06d}.color.png", k)
        write_depth(folder / f"data/frame-{k:06d}.depth.png", k)
    K = np.array([[57.0, 0, 32, 0], [0, 57, 24, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    for kind in ("color", "depth"):
        (folder / f"data/{kind}Intrinsics.txt").write_text(rows(K))
    for other in ("canonical", "reconstruction"):
        (folder / other).mkdir()
        (folder / other / "frame-000000.canonical.ply").write_text("ply\n")
    (folder / "poses.txt").write_text("".join(" ".join(f"{v:.9f}" for v in pose(k).ravel()) + "\n" for k in range(3)))
    return Layout("VolumeDeform", (57, 57, 32, 24))


def scannet(folder):
    for k in range(3):
        write_color(folder / f"color/{10 * k}.jpg", k, 96, 72)
        write_depth(folder / f"depth/{10 * k}.png", k)
        (folder / "pose").mkdir(exist_ok=True)
        T = pose(k) if k != 1 else np.full((4, 4), -np.inf)
        (folder / f"pose/{10 * k}.txt").write_text(rows(T))
    (folder / "intrinsic").mkdir()
    depth = np.diag([58.0, 59.0, 1, 1])
    depth[:2, 2] = 31, 23
    color_matrix = np.diag([88.0, 89.0, 1, 1])
    color_matrix[:2, 2] = 47, 35
    to_common = np.eye(4)
    to_common[:3, 3] = [0.02, 0, 0.001]  # the colour camera 20 mm to the right of the depth camera
    for name, matrix in (
        ("intrinsic_depth", depth), ("intrinsic_color", color_matrix),
        ("extrinsic_depth", np.eye(4)), ("extrinsic_color", to_common),
    ):  # fmt: skip
        (folder / f"intrinsic/{name}.txt").write_text(rows(matrix))
    return Layout(
        "ScanNet export", (58, 59, 31, 23), stamps=[0, 1 / 3, 2 / 3], truth=[pose(0), pose(2)],
        color=(88, 89, 47, 35, (72, 96)), T_color_depth=np.linalg.inv(to_common),
    )  # fmt: skip


def replica(folder):
    for k in range(3):
        write_color(folder / f"results/frame{k:06d}.jpg", k)
        write_depth(folder / f"results/depth{k:06d}.png", k, 6553.5)
    (folder / "traj.txt").write_text("".join(" ".join(f"{v:.9e}" for v in pose(k).ravel()) + "\n" for k in range(3)))
    camera = {"w": 64, "h": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "scale": 6553.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return Layout("Replica (NICE-SLAM)", (60, 60, 31.5, 23.5))


def redwood(folder):
    text = ""
    for k in range(3):
        write_color(folder / f"color/{k:05d}.jpg", k)
        write_depth(folder / f"depth/{k:05d}.png", k)
        text += f"{k} {k} {k + 1}\n" + rows(pose(k))
    (folder / "trajectory.log").write_text(text)
    (folder / "camera_primesense.json").write_text(open3d_camera())
    return Layout("Redwood or Open3D", (60, 61, 31, 23))


def redwood_object(folder):
    for k in range(3):
        write_color(folder / f"rgb/{k + 1:07d}-{k * 33368:012d}.jpg", k, 640, 480)
        write_depth(folder / f"depth/{k + 1:07d}-{k * 33368:012d}.png", k, width=640, height=480)
    return Layout("Redwood or Open3D", (525, 525, 319.5, 239.5), (480, 640), stamps=[0, 0.033368, 0.066736], truth=None)


OPENLORIS = """%YAML:1.0
---
d400_color_optical_frame:
   sensor_type: camera
   fps: 30
   width: 64
   height: 48
   model: pinhole
   intrinsics: !!opencv-matrix
      rows: 1
      cols: 4
      dt: d
      data: [ 6.0e+01, 3.1e+01,
          6.1e+01, 2.3e+01 ]
   distortion_model: radial-tangential
   distortion_coefficients: !!opencv-matrix
      rows: 1
      cols: 4
      dt: d
      data: [ 0., 0., 0., 0. ]
"""


def openloris(folder):
    T_base_laser, T_laser_camera = np.eye(4), np.eye(4)
    T_base_laser[:3, 3] = [0.1, 0.0, 1.0]
    T_laser_camera[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # from x forward, z up to x right, z forward
    lines = {"color": "#Time file\n", "aligned_depth": "", "depth": "", "groundtruth": "#Time px py pz qx qy qz qw\n"}
    for k in range(3):
        stamp = f"{1560000077.5 + 0.1 * k:.6f}"
        write_color(folder / f"color/{stamp}.png", k)
        write_depth(folder / f"aligned_depth/{stamp}.png", k)
        for kind in ("color", "aligned_depth", "depth"):
            lines[kind] += f"{stamp} {kind}/{stamp}.png\n"
        base = pose(k) @ np.linalg.inv(T_base_laser @ T_laser_camera)
        lines["groundtruth"] += f"{stamp} " + " ".join(f"{v:.9f}" for v in [*base[:3, 3], *quaternion(base[:3, :3])])
        lines["groundtruth"] += "\n"
    for name, text in lines.items():
        (folder / f"{name}.txt").write_text(text)
    (folder / "sensors.yaml").write_text(OPENLORIS)
    tree = "%YAML:1.0\n---\ntrans_matrix:\n"
    # the second matrix is given from the child's side, so that it must be inverted on the way
    for parent, child, T in (
        ("base_link", "laser", T_base_laser), ("d400_color_optical_frame", "laser", np.linalg.inv(T_laser_camera)),
    ):  # fmt: skip
        data = ", ".join(f"{v:.9e}" for v in T.ravel())
        tree += f"   -\n      parent_frame: {parent}\n      child_frame: {child}\n      matrix: !!opencv-matrix\n"
        tree += f"         rows: 4\n         cols: 4\n         dt: d\n         data: [ {data} ]\n"
    (folder / "trans_matrix.yaml").write_text(tree)
    return Layout("OpenLORIS-Scene", (60, 61, 31, 23), stamps=[1560000077.5, 1560000077.6, 1560000077.7])


def epfl(folder):
    for k in range(3):
        write_color(folder / f"rgb{k + 33:06d}.png", k, 512, 424)
        write_depth(folder / f"depth{k + 33:06d}.png", k, width=512, height=424)
    camera = (365.8046307762528, 365.80463336811664, 254.31510758228475, 206.98513348550657)
    return Layout(
        "EPFL RGB-D Pedestrian", camera, (424, 512), stamps=[33 / 30, 34 / 30, 35 / 30], truth=None,
        name="20140804_160621_00",
    )  # fmt: skip


LAYOUTS = (
    tum, bonn, icl_nuim, icl_nuim_loop, corbs, seven_scenes, tsdf_fusion, with_matrices, bop, volume_deform, scannet,
    replica, redwood, redwood_object, openloris, epfl, nerfstudio, stray_scanner, arkit_scenes, polycam, realsense,
    azure_kinect, zed, timed, record3d, suffixed,
)  # fmt: skip


def write(layout, parent):
    """Folder of a layout below a new folder, and what it must be read as."""
    place = Path(parent) / "unnamed"
    place.mkdir(parents=True)
    expected = layout(place)
    folder = place.with_name(expected.name or layout.__name__)
    shutil.move(place, folder)
    return folder, expected
