"""Every folder layout, written by independent code, is recognised and read: cameras, images, times and truth."""

import json
import re
import shutil
import tarfile
import zipfile

import cv2
import numpy as np
import pytest

from device_layouts import nerfstudio, realsense, zed
from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError, FrameError
from dudmap.io.sequences import Recording, open_sequence, reader_of
from layout_images import color, millimetres, pose
from layouts import LAYOUTS, corbs, icl_nuim, replica, scannet, seven_scenes, tum, write

SUFFIXES = (".zip", ".tar", ".tgz")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Folders of the layouts, each written once."""
    known = {}

    def get(layout):
        if layout not in known:
            known[layout] = write(layout, tmp_path_factory.mktemp(layout.__name__))
        return known[layout]

    return get


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DUDMAP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def pack(folder, file):
    """Archive that holds a folder, as data sets are packed."""
    if file.suffix == ".zip":
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for path in sorted(folder.rglob("*")):
                archive.write(path, path.relative_to(folder.parent))
    else:
        kind = {"mode": "w:gz", "compresslevel": 1} if file.suffix == ".tgz" else {"mode": "w"}
        with tarfile.open(file, **kind) as archive:
            archive.add(folder, folder.name)
    return file


def check(sequence, expected):
    assert isinstance(sequence, Recording)
    assert sequence.format == expected.format
    assert all(sequence.sources[what] for what in ("intrinsics", "depth unit", "times"))
    camera = sequence.camera
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], expected.intrinsics, rtol=1e-6)
    assert camera.shape == expected.shape
    np.testing.assert_allclose(sequence.timestamps, expected.stamps, atol=1e-6)
    assert len(sequence) == 3
    check_color_camera(sequence, expected)
    if expected.truth is None:
        assert sequence.ground_truth is None
    else:
        np.testing.assert_allclose(sequence.ground_truth.Ts_world_camera, expected.truth, atol=1e-6)
        assert set(np.round(sequence.ground_truth.timestamps, 4)) <= set(np.round(sequence.timestamps, 4))
    for k in expected.numbers:
        frame = sequence[k]
        height, width = expected.shape
        np.testing.assert_allclose(frame.depth, millimetres(k, width, height) / 1000, atol=1e-4)
        height, width = expected.shape if expected.color is None else expected.color[4]
        difference = np.abs(frame.color.astype(int) - color(k, width, height))
        assert difference.max() <= 12, "JPEG and video are not exact"
        assert difference[..., 0].mean() <= 4, "the images before and after differ by 10 in red"
        assert frame.timestamp == sequence.timestamps[k]


def check_color_camera(sequence, expected):
    if expected.color is None:
        assert sequence.calibration is None
        return
    camera = sequence.calibration.camera
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], expected.color[:4], rtol=1e-6)
    assert camera.shape == expected.color[4]
    np.testing.assert_allclose(sequence.calibration.T_color_depth, expected.T_color_depth, atol=1e-5)


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.__name__)
def test_a_folder(layout, written):
    folder, expected = written(layout)
    check(open_sequence(folder), expected)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.__name__)
def test_its_archive(layout, suffix, written, tmp_path, cache):
    folder, expected = written(layout)
    check(open_sequence(pack(folder, tmp_path / f"packed{suffix}")), expected)


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.__name__)
def test_no_other_reader_takes_a_layout(layout, written):
    folder, expected = written(layout)
    assert expected.format in reader_of(folder).format


def test_a_given_camera_replaces_that_of_the_depth_images(written):
    folder, _ = written(scannet)
    sequence = open_sequence(folder, "50,51,32,24,64,48,2000")
    assert sequence.camera == Camera(50, 51, 32, 24, 64, 48, 2000.0)
    assert sequence.calibration.camera.fx == 88  # the colour camera stays
    assert open_sequence(folder, "50,51,32,24").camera.depth_scale == 1000
    assert open_sequence(written(tum)[0], "50,51,32,24").camera.depth_scale == 5000


def test_the_truth_of_corbs_is_a_download_of_its_own(written, tmp_path, cache):
    folder, expected = write(corbs, tmp_path / "D1")
    truth = tmp_path / "D1" / "D1_Trajectory"
    truth.mkdir()
    (folder / "groundtruth.txt").rename(truth / "groundtruth.txt")
    check(open_sequence(folder), expected)
    check(open_sequence(tmp_path / "D1"), expected)  # the folder of both
    downloads = tmp_path / "downloads"
    downloads.mkdir()
    archive = pack(folder, downloads / f"{folder.name}.zip")
    assert open_sequence(archive).ground_truth is None
    pack(truth, downloads / "D1_Trajectory.zip")
    check(open_sequence(archive), expected)


def test_the_camera_beside_7_scenes_is_that_of_the_depth(written, tmp_path):
    folder, expected = write(seven_scenes, tmp_path / "a")
    (folder / "camera-intrinsics.txt").write_text("580 0 321\n0 581 241\n0 0 1\n")
    sequence = open_sequence(folder)
    assert sequence.camera == Camera(580, 581, 321, 241, 640, 480, 1000.0)
    check_color_camera(sequence, expected)
    (folder / "intrinsics.txt").write_text("585 585 320 240\n")  # our own file: registered images
    assert open_sequence(folder).calibration is None


def test_a_sequence_of_icl_nuim_with_times_of_its_own_is_not_taken_for_numbers(tmp_path):
    folder, _ = write(icl_nuim, tmp_path / "a")
    (folder / "livingRoom2.gt.freiburg").write_text("100.5 0 0 0 0 0 0 1\n")
    sequence = open_sequence(folder)
    assert sequence.ground_truth is None
    assert "livingRoom2.gt.freiburg, line 1: expected the number of a frame" in sequence.remarks[0]


def test_a_plain_folder_asks_for_its_camera(tmp_path):
    folder, _ = write(zed, tmp_path / "a")
    (folder / "calibration.json").unlink()
    with pytest.raises(DatasetError, match=r"is not known.*give --camera fx,fy,cx,cy\[,w,h\[,depth_scale\]\]"):
        open_sequence(folder)
    assert open_sequence(folder, "60,61,31,23").camera == Camera(60, 61, 31, 23, 64, 48, 1000.0)
    (folder / "intrinsics.txt").write_text("fx 70\nfy 61\ncx 31\ncy 23\ndepth_scale 5000\n")
    assert open_sequence(folder).camera.depth_scale == 5000


def test_an_svo_export_of_the_zed_sdk(tmp_path):
    """Mode 4 of its sample (LEFT+DEPTH_16Bit): BGRA images and millimetres; mode 3 shows depth as 8-bit images."""
    folders = [tmp_path / f"mode{mode}" for mode in (3, 4)]
    for folder, view in zip(folders, (True, False), strict=True):
        folder.mkdir()
        for k in range(3):
            opaque = np.full((48, 64, 1), 255, np.uint8)
            depth = millimetres(k)
            shown = np.dstack([(depth // 16).astype(np.uint8)] * 3 + [opaque])
            cv2.imwrite(str(folder / f"left{k:06d}.png"), np.dstack([color(k)[..., ::-1], opaque]))
            cv2.imwrite(str(folder / f"depth{k:06d}.png"), shown if view else depth)
    recording = open_sequence(folders[1], "60,61,31,23", fps=15)
    np.testing.assert_allclose(recording.timestamps, np.arange(3) / 15)
    for k in range(3):
        np.testing.assert_array_equal(recording[k].color, color(k))
        np.testing.assert_allclose(recording[k].depth, millimetres(k) / 1000, atol=1e-6)
    with pytest.raises(DatasetError, match=r"depthN.png \(3 with 8-bit colours\).*expected .* depth images of 16 bit"):
        open_sequence(folders[0], "60,61,31,23")


def test_gray_images_stand_for_colour_where_there_are_no_others(tmp_path):
    folder, expected = write(realsense, tmp_path / "a")
    shutil.copytree(folder / "color", folder / "mono")
    assert open_sequence(folder)._pairs[0][0].path.parent.name == "color"
    shutil.rmtree(folder / "color")
    check(open_sequence(folder), expected)


def test_several_recordings_in_one_place_are_named(tmp_path, cache):
    for name in ("seq-01", "seq-02"):
        write(tum, tmp_path / "chess")
        (tmp_path / "chess" / "tum").rename(tmp_path / "chess" / name)
    with pytest.raises(DatasetError, match=r"contains 2 recordings; name one of seq-01, seq-02"):
        open_sequence(tmp_path / "chess")
    archive = pack(tmp_path / "chess", tmp_path / "chess.zip")
    with pytest.raises(DatasetError, match=r"contains 2 recordings; name one of chess/seq-01, chess/seq-02"):
        open_sequence(archive)
    assert open_sequence(archive / "chess" / "seq-02").name == "seq-02"
    with pytest.raises(DatasetError, match="there is no folder or file"):
        open_sequence(archive / "chess" / "seq-03")


def test_archives_in_archives(tmp_path, cache):
    """As 7-Scenes is packed."""
    folder, expected = write(tum, tmp_path / "a")
    inner = tmp_path / "chess"
    inner.mkdir()
    pack(folder, inner / "seq-01.zip")
    check(open_sequence(pack(inner, tmp_path / "chess.zip")), expected)


def test_numbers_that_do_not_pair(tmp_path):
    folder, _ = write(zed, tmp_path / "a")
    for k, path in enumerate(sorted(folder.glob("depth*.png"))):
        path.rename(folder / f"depth{k + 10:06d}.png")
    with pytest.raises(DatasetError, match="3 colour and 3 depth images, but none of them has the same number"):
        open_sequence(folder)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda tree: tree.pop("fl_x"), "lacks fl_x"),
        (lambda tree: [frame.pop("depth_file_path") for frame in tree["frames"]], "names no depth images"),
        (lambda tree: tree.update(camera_model="OPENCV_FISHEYE"), "camera model OPENCV_FISHEYE"),
        (lambda tree: tree.pop("frames"), "frames"),
    ],
)
def test_a_transforms_file_that_cannot_be_used(tmp_path, change, sentence):
    folder, _ = write(nerfstudio, tmp_path / "a")
    tree = json.loads((folder / "transforms.json").read_text())
    change(tree)
    (folder / "transforms.json").write_text(json.dumps(tree))
    with pytest.raises(DatasetError, match=sentence):
        open_sequence(folder)


def test_depth_of_nerfstudio_as_arrays(tmp_path):
    folder, _ = write(nerfstudio, tmp_path / "a")
    for path in folder.glob("depth/*.png"):
        np.save(path.with_suffix(".npy"), (cv2.imread(str(path), cv2.IMREAD_UNCHANGED) / 1000)[..., None])
    text = (folder / "transforms.json").read_text()
    (folder / "transforms.json").write_text(re.sub(r"(depth/frame_\d+)\.png", r"\1.npy", text))
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence[1].depth, millimetres(1) / 1000, rtol=1e-6)
    (folder / "depth/frame_10.npy").write_bytes(b"\x93NUMPY nonsense")
    with pytest.raises(FrameError, match=r"cannot read the array .*frame_10\.npy"):
        sequence[1]


def test_a_missing_pose_file_of_scannet_is_a_frame_without_truth(tmp_path):
    folder, _ = write(scannet, tmp_path / "a")
    (folder / "pose/0.txt").unlink()
    np.testing.assert_allclose(open_sequence(folder).ground_truth.Ts_world_camera, [pose(2)], atol=1e-6)


GARBAGE = (
    b"",
    b"\xff\xfe\x00\x01",
    b"[]",
    b"{}",
    b"1 2 3\n",
    b"a b c d e f g h i\n",
    b'{"frames": [{}], "K": [[1], 2]}',
    b"-5\n",
)


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.__name__)
def test_a_spoilt_text_file_is_one_sentence(layout, tmp_path):
    """Whatever stands in lists, poses and calibrations: the folder opens, or says what is wrong with it."""
    folder, _ = write(layout, tmp_path)
    texts = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix not in (".png", ".jpg", ".ply"):
            texts.setdefault(re.sub(r"\d+", "", str(path)), path)
    said = []
    for path in texts.values():
        whole = path.read_bytes()
        for text in (*GARBAGE, whole[: len(whole) // 2], whole.replace(b"0", b"nan"), whole.replace(b"[", b"")):
            path.write_bytes(text)
            try:
                open_sequence(folder)[0]
            except DatasetError as error:
                said.append(str(error))
        path.write_bytes(whole)
    assert all(len(sentence) < 700 and "\n" not in sentence for sentence in said)
    assert open_sequence(folder)[0].depth.any()


def test_rate_and_depth_unit_are_given(tmp_path):
    folder, _ = write(replica, tmp_path)
    assumed = open_sequence(folder)
    assert not assumed.timed
    known = open_sequence(folder, fps=5, depth_unit=0.002)
    assert known.timed
    np.testing.assert_allclose(known.timestamps, [0, 0.2, 0.4])
    np.testing.assert_allclose(known.ground_truth.timestamps, [0, 0.2, 0.4])
    assert known[2].timestamp == known[2].color_timestamp == pytest.approx(0.4)
    np.testing.assert_allclose(known[1].depth, assumed[1].depth * 0.002 * 6553.5, rtol=1e-6)


def test_rate_is_that_of_the_images_that_lie_there(tmp_path):
    folder, _ = write(scannet, tmp_path)  # every tenth frame of a recording
    assert open_sequence(folder, fps=4).timestamps == pytest.approx([0, 0.25, 0.5])


def test_rate_of_timed_recordings_is_theirs(tmp_path):
    folder, _ = write(tum, tmp_path)
    assert open_sequence(folder).timed
    with pytest.raises(DatasetError, match=r"has times of its own.* leave --fps out"):
        open_sequence(folder, fps=5)


@pytest.mark.parametrize("numbers", [{"fps": 0}, {"depth_unit": -1.0}, {"fps": float("nan")}])
def test_rate_and_depth_unit_are_positive(tmp_path, numbers):
    folder, _ = write(replica, tmp_path)
    with pytest.raises(DatasetError, match="expected a positive number"):
        open_sequence(folder, **numbers)
