"""The public names: documented, importable, cheap; and ``Slam.process`` with plain arrays."""

import copy
import inspect
import pickle
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dudmap
from dudmap import ConfigError, DatasetError, Frame, Slam
from wavy_wall import CAMERA, wall

DOCS = Path(__file__).parents[1] / "docs"
PAGE = "".join((DOCS / name).read_text(encoding="utf-8") for name in ("python.md", "api.rst"))


@pytest.mark.parametrize("name", dudmap.__all__)
def test_every_public_name_is_importable_and_documented(name):
    value = getattr(dudmap, name)
    listed = PAGE.partition("## Public names")[2]
    assert name in re.findall(r"(?:`|^\.\. auto\w+:: dudmap\.)(\w+)", listed, re.MULTILINE)
    if name != "__version__":
        assert inspect.getdoc(value)
        public = [
            member
            for key, member in vars(value).items()
            if not key.startswith("_") and inspect.isfunction(member)
        ] if inspect.isclass(value) else []  # fmt: skip
        assert [member.__qualname__ for member in public if not inspect.getdoc(member)] == []


def annotations(name):
    """Texts of the annotations of a public function, or of a class: its arguments and its documented members."""
    value = getattr(dudmap, name)
    if inspect.isfunction(value):
        return [value.__annotations__]
    if not inspect.isclass(value) or issubclass(value, Exception) or name == "FrameView":  # only passed on
        return []
    (options,) = re.findall(rf"autoclass:: dudmap\.{name}\n((?:   :.*\n)*)", PAGE)
    listed = re.search(r":members: (.+)", options)
    left_out = re.findall(r"\w+", (re.search(r":exclude-members: (.+)", options) or ["", ""])[1])
    members = re.findall(r"\w+", listed[1]) if listed else [key for key in dir(value) if key[0] != "_"]
    members = [inspect.getattr_static(value, key) for key in members if key not in left_out]
    functions = [getattr(found, "fget", None) or getattr(found, "__func__", found) for found in members]
    own = [value.__init__, *functions] if ":members:" in options else [value.__init__]
    return [found.__annotations__ for found in own if inspect.isfunction(found)]


CLASSES = {
    name
    for file in Path(dudmap.__file__).parent.rglob("*.py")
    for name in re.findall(r"^class ([A-Z]\w+)", file.read_text(encoding="utf-8"), re.MULTILINE)
}


@pytest.mark.parametrize("name", dudmap.__all__)
def test_types_of_a_public_name_are_public(name):
    texts = [
        text if isinstance(text, str) else inspect.formatannotation(text)
        for found in annotations(name)
        for key, text in found.items()
        if not key.startswith("_")
    ]
    named = {word for text in texts for word in re.findall(r"\b[A-Z]\w+", text)} & CLASSES
    assert named - set(dudmap.__all__) - INSIDE == set()


INSIDE = {
    "Backend",
    "Keyframe",
    "RegistrationHistory",
    "Segmentation",
    "Mixture",
    "Observation",
    "Level",
    "Scalar",
}
"""Types of attributes that only the core makes and reads."""


def test_results_are_pickled_and_copied():
    slam = Slam(CAMERA)
    results = [slam.process(wall(1.5 + 0.01 * number, seed=number)) for number in range(3)]
    for copied in (lambda value: pickle.loads(pickle.dumps(value)), copy.deepcopy, copy.copy):
        found = copied(results[-1])
        np.testing.assert_array_equal(found.T_world_camera, results[-1].T_world_camera)
        np.testing.assert_array_equal(found.dynamic_mask, results[-1].dynamic_mask)
        assert found.movers == results[-1].movers
        np.testing.assert_array_equal(copied(slam.trajectory).Ts_world_camera, slam.trajectory.Ts_world_camera)
    mesh = slam.volume.extract_mesh()
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(mesh)).vertices, mesh.vertices)
    again = pickle.loads(pickle.dumps(slam.volume)).extract_mesh()
    np.testing.assert_array_equal(again.vertices, mesh.vertices)


def test_other_names_are_refused():
    with pytest.raises(AttributeError, match="module 'dudmap' has no attribute 'nonsense'"):
        _ = dudmap.nonsense


def test_errors_load_nothing_heavy():
    script = "import sys; from dudmap import DudmapError, CameraError; print('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_arrays_give_the_same_result_as_frames():
    one, other, scaled = Slam(CAMERA), Slam(CAMERA), Slam(CAMERA)
    for number in range(3):
        frame = wall(1.5 + 0.01 * number, seed=number)
        depth = np.rint(1000 * frame.depth).astype(np.float32) / np.float32(1000)
        frame = Frame(frame.timestamp / 30, depth, frame.color)
        expected = one.process(frame)
        arrays = {"rgb": frame.color, "timestamp": frame.timestamp}
        found = other.process(depth=frame.depth, **arrays)
        millimetres = scaled.process(depth=np.rint(1000 * frame.depth).astype(np.uint16), **arrays)
        for result in (found, millimetres):
            assert result.status == expected.status
            if expected.T_world_camera is not None:
                np.testing.assert_array_equal(result.T_world_camera, expected.T_world_camera)


def test_units_and_readings_of_arrays():
    rgb = np.zeros((2, 3, 3), np.uint8)
    depth = np.array([[0, 1000, 65535], [500, 0, 1]], np.uint16)
    np.testing.assert_allclose(Frame.from_arrays(depth, rgb, 1).depth, depth / 1000)
    np.testing.assert_allclose(Frame.from_arrays(depth, rgb, 1, depth_scale=5000).depth, depth / 5000)
    found = Frame.from_arrays(np.array([[np.nan, 1.5, np.inf], [0, -np.inf, 2]]), rgb, 1).depth
    np.testing.assert_array_equal(found, np.array([[0, 1.5, 0], [0, 0, 2]], np.float32))
    assert found.dtype == np.float32


GOOD: dict[str, Any] = {
    "depth": np.ones(CAMERA.shape, np.float32), "rgb": np.zeros((*CAMERA.shape, 3), np.uint8), "timestamp": 0.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"depth": np.ones(CAMERA.shape, np.int32)}, r"depth has the shape \(48, 64\) and the type int32; expected"),
        ({"depth": np.ones((*CAMERA.shape, 1), np.float32)}, r"depth has the shape \(48, 64, 1\) .* expected \(H, W\)"),
        ({"depth": np.ones((10, 20), np.float32)}, "the camera is 64x48, but the depth image has the shape"),
        ({"rgb": np.zeros(CAMERA.shape, np.uint8)}, r"rgb has the shape \(48, 64\) and the type uint8; expected"),
        ({"rgb": np.zeros((*CAMERA.shape, 3), np.float32)}, "the type float32; expected .* uint8, red green blue"),
        ({"timestamp": float("nan")}, "the timestamp is nan; expected a finite number of seconds"),
        ({"depth": np.full(CAMERA.shape, 1500.0)}, "most depths are above 65.535 .* divide millimetres by 1000"),
    ],
)
def test_bad_arrays_are_one_sentence(changed, sentence):
    with pytest.raises(DatasetError, match=sentence):
        Slam(CAMERA).process(**(GOOD | changed))


def test_an_image_in_place_of_a_frame_is_one_sentence():
    with pytest.raises(DatasetError, match="the frame is a ndarray; expected a Frame, or depth= and rgb="):
        Slam(CAMERA).process(GOOD["depth"])


def test_frames_and_arrays_are_not_mixed():
    mixed: list[dict[str, Any]] = [{}, GOOD | {"frame": wall(1.0)}, {"depth": GOOD["depth"], "rgb": GOOD["rgb"]}]
    for arguments in mixed:
        with pytest.raises(ConfigError, match="either a frame, or depth=, timestamp="):
            Slam(CAMERA).process(**arguments)
