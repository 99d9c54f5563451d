"""Twelve layouts of folders by ten ways to leave a camera in them; and files of intrinsics as strangers write them."""

import json

import cv2
import numpy as np
import pytest

from dudmap.app.pipeline.inspection import inspect
from dudmap.errors import DatasetError
from dudmap.io.sequences import open_sequence
from layout_images import color, millimetres, pose, tum_line, write_color, write_depth
from layouts import seven_scenes, write

K = np.array([[60.0, 0, 31.0], [0, 61.0, 23.0], [0, 0, 1]])
CAMERA = (60, 61, 31, 23)
SCALARS = {"fx": 60.0, "fy": 61.0, "cx": 31.0, "cy": 23.0}

LAYOUTS = {
    "color/ and depth/": ("color/{k:06d}.png", "depth/{k:06d}.png"),
    "images/ and depth/": ("images/{k}.jpg", "depth/{k}.png"),
    "one folder, a word each": ("left{k:06d}.png", "depth{k:06d}.png"),
    "one folder, depth with a suffix": ("desk_{k}.png", "desk_{k}_depth.png"),
    "one folder, told by the suffix": ("{k}.jpg", "{k}.png"),
    "depths_and_images/": ("depths_and_images/image_{k}.png", "depths_and_images/depth_{k}.png"),
    "rgbd-frames/": ("rgbd-frames/frame{k:04d}.jpg", "rgbd-frames/depth{k:04d}.png"),
    "Frames/ and depth/": ("Frames/{k}.png", "depth/{k}.png"),
    "RGB/ and D/": ("RGB/{k}.png", "D/{k}.png"),
    "rgb_N and d_N": ("rgb_{k}.png", "d_{k}.png"),
    "seconds and nanoseconds": ("color_1305031102_{ns}.png", "depth_1305031102_{ns}.png"),
    "TUM lists in nanoseconds": ("rgb/{k}.png", "depth/{k}.png"),
}


def write_images(folder, layout):
    color_name, depth_name = LAYOUTS[layout]
    lines = {"rgb": "", "depth": ""}
    for k in range(3):
        names = {kind: name.format(k=k, ns=5_000_000 + 33_333_333 * k) for kind, name in
                 (("rgb", color_name), ("depth", depth_name))}  # fmt: skip
        write_color(folder / names["rgb"], k)
        write_depth(folder / names["depth"], k)
        for kind, name in names.items():
            lines[kind] += f"{1305031102000000000 + 33_333_333 * k} {name}\n"
    if layout.startswith("TUM"):
        for kind, text in lines.items():
            (folder / f"{kind}.txt").write_text(text)


def calib_txt(folder):
    np.savetxt(folder / "calib.txt", K)


def camera_matrix_in_brackets(folder):
    (folder / "Camera_Matrix.txt").write_text(str(K) + "\n")


def bare_list(folder):
    (folder / "intrinsics.json").write_text(json.dumps(K.tolist()))


def lines_with_equal_signs(folder):
    text = "".join(f"{name} = {value} px\n" for name, value in SCALARS.items())
    (folder / "camera.cfg").write_text(f"# of the sensor\n{text}")


def table(folder):
    (folder / "camera_intrinsics.csv").write_text("fx,fy,cx,cy,width,height\n60,61,31,23,64,48\n")


def array(folder):
    np.save(folder / "intrinsic_matrix.npy", K)


def params(folder):
    tree = {"depth_scale": 0.001, "camera": {"cam_K": K.ravel().tolist(), "image_size": [64, 48]}, "fps": 30}
    (folder / "params.json").write_text(json.dumps(tree))


def config_beside(folder):
    (folder.parent / "config").mkdir()
    np.savetxt(folder.parent / "config" / "K.txt", K, delimiter=",")


def one_per_frame(folder):
    for k in range(3):
        (folder / f"intrinsics_{k}.json").write_text(json.dumps(SCALARS | {"width": 64, "height": 48}))


def nested_yaml(folder):
    text = "CameraIntrinsics:\n  CameraMatrix:\n    CX: 31.0\n    CY: 23.0\n    FX: 60.0\n    FY: 61.0\n"
    (folder / "Calibration.yml").write_text(text + "  Distortion:\n    K1: 0\n    K2: 0\n")


CAMERAS = (
    calib_txt, camera_matrix_in_brackets, bare_list, lines_with_equal_signs, table, array, params, config_beside,
    one_per_frame, nested_yaml,
)  # fmt: skip


def intrinsics_of(sequence):
    camera = sequence.camera
    return camera.fx, camera.fy, camera.cx, camera.cy


NOT_READ = [("depths_and_images/", config_beside), ("rgbd-frames/", config_beside)]
"""The camera lies two folders above the images: it may be of another recording. At most 15 % may stand here."""
PAIRS = [(layout, camera) for layout in LAYOUTS for camera in CAMERAS if (layout, camera) not in NOT_READ]


def test_most_of_the_matrix_is_read():
    assert len(PAIRS) >= 0.85 * len(LAYOUTS) * len(CAMERAS)


@pytest.mark.parametrize(("layout", "camera"), NOT_READ)
def test_a_camera_two_folders_up_is_asked_for(tmp_path, layout, camera):
    folder = tmp_path / "recording" / "data"
    folder.mkdir(parents=True)
    write_images(folder, layout)
    camera(folder)
    with pytest.raises(DatasetError, match=r"the camera of .* is not known.*give --camera"):
        open_sequence(folder)


@pytest.mark.parametrize(
    ("layout", "camera"), PAIRS, ids=lambda value: value if isinstance(value, str) else value.__name__
)
def test_every_layout_with_every_camera(tmp_path, layout, camera):
    folder = tmp_path / "recording" / "data"
    folder.mkdir(parents=True)
    write_images(folder, layout)
    camera(folder)
    sequence = open_sequence(folder)
    assert intrinsics_of(sequence) == CAMERA
    assert sequence.calibration is None
    assert len(sequence) == 3
    for k in range(3):
        unit = 1000 / sequence.camera.depth_scale
        np.testing.assert_allclose(sequence[k].depth, millimetres(k) / 1000 * unit, atol=1e-4)
        assert np.abs(sequence[k].color[..., 0].astype(int) - color(k)[..., 0]).mean() < 4


# -- files of intrinsics of public repositories, in their forms --------------------------------------------------------

PROJECTION = " ".join(map(str, [60.0, 0, 31.0, 0, 0, 61.0, 23.0, 0, 0, 0, 1, 0]))
RATIONAL = [0.0] * 5
FORMS = {
    "realsense_intrinsics.json": json.dumps(
        {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "ppx": 31.0, "ppy": 23.0, "K": K.tolist(),
         "model": "distortion.brown_conrady", "coeffs": RATIONAL}
    ),
    "camera_params.json": json.dumps({"fx": 60, "fy": 61, "x_offset": 31, "y_offset": 23, "height": 48, "width": 64}),
    "cam_intrinsics.txt": "60 61 31 23 64 48\n",
    "board_calib.txt": "K:\n60.0 0.0 31.0\n0.0 61.0 23.0\n0.0 0.0 1.0\nD:\n0 0 0 0 0\n",
    "calib.txt": "60.0 61.0 31.0 23.0 0 0 0 0\n",
    "camera_calibration.json": json.dumps({"mtx": K.tolist(), "dist": [RATIONAL], "rms": 0.2}),
    "calib_kitti.txt": f"P0: {PROJECTION}\nP1: {PROJECTION}\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n",
    "cameras.txt": "# Camera list\n1 PINHOLE 64 48 60.0 61.0 31.0 23.0\n",
    "scene_params.txt": "fx_depth = 60\nfy_depth = 61\nmx = 7\ncx_depth = 31\ncy_depth = 23\ndepthWidth = 64\n",
    "intrinsics.yaml": "width: 64\nheight: 48\ncalibration: [60.0, 61.0, 31.0, 23.0]\n",
    "CAMERA.JSON": json.dumps({"FocalLength": [60.0, 61.0], "PrincipalPoint": [31.0, 23.0], "ImageSize": [48, 64]}),
    "cam0_info": "image_width 64\nimage_height 48\nfocal_x 60\nfocal_y 61\nprincipal_x 31\nprincipal_y 23\n",
    "poses_and_camera.json": json.dumps(
        {"frames": [{"transform": np.eye(4).tolist(), "intrinsics": K.tolist()}] * 3, "w": 64, "h": 48}
    ),
    "pixel_params.txt": "Resolution: 64x48\nFocal length 60.0 61.0 pixels\nPrincipal point 31.0 23.0\n",
    "k.csv": "60,0,31\n0,61,23\n0,0,1\n",
    "camera_4x4.txt": "60 0 31 0\n0 61 23 0\n0 0 1 0\n0 0 0 1\n",
}  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "recording" / "data"
    place.mkdir(parents=True)
    write_images(place, "color/ and depth/")
    return place


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize("place", ["in it", "one folder up"])
def test_files_as_strangers_write_them(folder, name, place):
    (folder if place == "in it" else folder.parent).joinpath(name).write_text(FORMS[name])
    sequence = open_sequence(folder)
    assert intrinsics_of(sequence) == CAMERA
    assert name in sequence.sources["intrinsics"]
    assert sequence.camera.distortion == ()


def test_arrays_of_an_archive(folder):
    np.savez(folder / "calib.npz", mtx=K, dist=np.zeros((1, 5)), rvecs=np.ones((4, 3)))
    assert intrinsics_of(open_sequence(folder)) == CAMERA


def test_coefficients_of_the_lens_are_kept(folder):
    tree = {"camera_matrix": K.tolist(), "dist_coeffs": [[0.1, -0.2, 0.001, 0.002, 0.05]]}
    (folder / "calibration_result.json").write_text(json.dumps(tree))
    np.savetxt(folder / "calib_matrix.txt", K)
    assert open_sequence(folder).camera.distortion == (0.1, -0.2, 0.001, 0.002, 0.05)
    (folder / "calibration_result.json").write_text(json.dumps(tree | {"model": "equidistant"}))
    with pytest.raises(DatasetError, match=r"the lens .* of the model equidistant is not read"):
        open_sequence(folder)


@pytest.mark.parametrize("name", ["camera_intrinsics.json", "lens_params.json"])
def test_the_inverse_lens_of_realsense_is_inverted(folder, name):
    inverse = k1, k2, p1, p2, _ = [-0.06, 0.04, 0.002, -0.001, 0.0]
    tree = {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "ppx": 31.0, "ppy": 23.0, "coeffs": inverse}
    (folder / name).write_text(json.dumps(tree | {"model": "distortion.inverse_brown_conrady"}))
    camera = open_sequence(folder).camera
    x, y = (8 - 31) / 60, (40 - 23) / 61  # a pixel near a corner, as librealsense deprojects it
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    ray = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y), 1.0
    pixel = cv2.projectPoints(np.array([ray]), np.zeros(3), np.zeros(3), camera.K, np.array(camera.distortion))[0]
    np.testing.assert_allclose(pixel.ravel(), [8, 40], atol=0.02)


# -- files that do not fit, and contradictory files --------------------------------------------------------------------


@pytest.mark.parametrize(("size", "factor"), [((128, 96), 2.0), ((96, 72), 1.5), ((32, 24), 0.5)])
def test_a_camera_of_another_resolution_is_scaled(folder, size, factor):
    values = {"fx": 60 * factor, "fy": 61 * factor, "cx": 31.5 * factor - 0.5, "cy": 23.5 * factor - 0.5}
    tree = {"camera": values, "resolution": list(size)}
    (folder / "params.json").write_text(json.dumps(tree))
    sequence = open_sequence(folder)
    np.testing.assert_allclose(intrinsics_of(sequence), CAMERA)
    expected = f"params.json, scaled from {size[0]}x{size[1]} to 64x48 pixels"
    assert sequence.sources["intrinsics"] == expected
    assert any(said.startswith(f"the camera is taken from {expected}; if") for said in inspect(sequence).warnings)


@pytest.mark.parametrize(
    "values",
    [
        {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5},  # of larger images, which are not named
        {"fx": 60.0, "fy": 61.0, "cx": 31.0, "cy": 23.0, "width": 80, "height": 48},
        {"fx": 60.0, "fy": 90.0, "cx": 31.0, "cy": 23.0},
        {"fx": 9.0, "fy": 9.0, "cx": 31.0, "cy": 23.0},
    ],
)
def test_a_camera_that_does_not_fit_is_named(folder, values):
    (folder / "params.json").write_text(json.dumps(values))
    with pytest.raises(DatasetError, match=r"no camera .* fits its images of 64x48 pixels: params\.json .*--camera"):
        open_sequence(folder)


def test_different_cameras_are_named_five_at_most(folder):
    for k in range(9):
        (folder / f"intrinsics_{k}.json").write_text(json.dumps(SCALARS | {"fx": 60.0 + k / 4}))
    with pytest.raises(DatasetError, match=r"different cameras lie at .*--camera") as found:
        open_sequence(folder)
    (folder / "calibration.txt").write_text("nothing of a camera\n")
    assert str(found.value).count(".json") <= 5
    for k in range(9):
        (folder / f"intrinsics_{k}.json").write_text(json.dumps(SCALARS | {"fx": 60.0 + k / 40}))
    assert open_sequence(folder).camera.fy == 61  # a fifth of a pixel is no difference


def test_depth_and_colour_of_their_own(folder):
    for k in range(3):
        write_color(folder / f"color/{k:06d}.png", k, 96, 72)
    (folder / "depth_intrinsics.txt").write_text("60 0 31\n0 61 23\n0 0 1\n")
    other = np.array([[88.0, 0, 47.0], [0, 89.0, 35.0], [0, 0, 1]])
    np.savetxt(folder / "rgb_camera.txt", other)
    sequence = open_sequence(folder)
    assert intrinsics_of(sequence) == CAMERA
    camera = sequence.calibration.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.shape) == (88, 89, 47, 35, (72, 96))
    (folder / "depth_intrinsics.txt").unlink()
    with pytest.raises(DatasetError, match=r"rgb_camera\.txt gives the camera of the colour images of 96x72 pixels"):
        open_sequence(folder)


def test_two_cameras_of_images_of_one_size_are_not_guessed_at(folder):
    other = {"fx": 45.0, "fy": 45.0, "cx": 32.0, "cy": 24.0}
    (folder / "sensor_params.json").write_text(json.dumps({"depth": SCALARS, "color": other}))
    with pytest.raises(DatasetError, match=r"60,61,31,23 for depth and 45,45,32,24 for colour, .* with --camera"):
        open_sequence(folder)


def test_the_nearest_folder_counts_and_usual_names_come_first(folder):
    np.savetxt(folder.parent / "calib.txt", K + 9 * (K > 40))
    np.savetxt(folder / "calib.txt", K)
    assert intrinsics_of(open_sequence(folder)) == CAMERA
    (folder / "intrinsics.txt").write_text("62 62 30 22\n")
    assert intrinsics_of(open_sequence(folder)) == (62, 62, 30, 22)
    assert intrinsics_of(open_sequence(folder, "50,50,32,24")) == (50, 50, 32, 24)


def test_published_intrinsics_come_before_files_of_any_name(tmp_path):
    named, _ = write(seven_scenes, tmp_path)
    np.savetxt(named / "calib.txt", [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    assert open_sequence(named).camera.fx == 585


def test_poses_and_matrices_of_other_things_are_no_cameras(folder):
    (folder / "camera_poses.txt").write_text("".join(tum_line(k, pose(k)) for k in range(3)))
    (folder / "cam_to_world.json").write_text(json.dumps({"T_cam": pose(0).tolist(), "quaternion": [0, 0, 0, 1]}))
    (folder / "camera_trajectory.csv").write_text("t,x,y,z\n0,1,2,3\n")
    (folder / "calibration.png").write_bytes(b"no text")
    (folder / "camera.npy").write_bytes(b"no array")
    with pytest.raises(DatasetError, match=r"cam_to_world\.json gives no camera.*give --camera"):
        open_sequence(folder)
    np.savetxt(folder / "k.txt", K)
    assert intrinsics_of(open_sequence(folder)) == CAMERA


def test_without_an_image_the_images_are_named(folder):
    for file in folder.rglob("*.png"):
        cv2.imwrite(str(file), np.zeros((48, 64), np.uint16))
        file.write_bytes(file.read_bytes()[:60])
    np.savetxt(folder / "calib.txt", K)
    with pytest.raises(DatasetError):
        open_sequence(folder)
