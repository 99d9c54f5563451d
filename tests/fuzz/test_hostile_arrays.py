"""NumPy arrays, archives of them and maps that declare what is not there."""

import numpy as np
import pytest
from hostile import npy, npz, refused

from dudmap.errors import DudmapError, MapError
from dudmap.input_files import load_array, open_arrays


@pytest.mark.parametrize(
    ("array", "change"),
    [("entries", lambda a: a + 1000), ("entries", lambda a: a * 0), ("entries", lambda a: -a),
     ("coords", lambda a: a * 0), ("coords", lambda a: a + 2**20), ("geometry", lambda a: a[:, :7]),
     ("geometry", lambda a: a.astype(np.int64)),
     ("colors", lambda a: a[:-1]), ("free_count", lambda a: a[:-1]), ("camera", lambda a: a * np.nan),
     ("image", lambda a: a * 10**6), ("depth_max", lambda a: np.array(np.inf)), ("depth_max", lambda a: np.array(1e30)),
     ("depth_max", lambda a: np.array(-1.0)), ("config", lambda a: np.array('{"voxel_size": 1e-9}'))],
)  # fmt: skip
def test_maps_whose_arrays_do_not_fit(array, change, tmp_path, subjects):
    from dudmap.core.map.volume import TsdfVolume

    with open_arrays(subjects("map").path) as found:
        content = {name: np.array(found[name]) for name in found}
    np.savez(tmp_path / "map.npz", **content)
    TsdfVolume.load(tmp_path / "map.npz")
    content[array] = change(content[array])
    np.savez(tmp_path / "map.npz", **content)
    refused(lambda: TsdfVolume.load(tmp_path / "map.npz"), DudmapError)


@pytest.mark.parametrize(
    ("array", "change"),
    [("slot_coords1", lambda a: a + 1000), ("slot_coords1", lambda a: a[:-1]), ("slot_coords1", lambda a: a * 0),
     ("geometry1", lambda a: a[:, :7]), ("colors1", lambda a: a.astype(np.float32))],
)  # fmt: skip
def test_smaller_voxels_that_do_not_fit_their_map(array, change, tmp_path, subjects):
    from dudmap.core.map.volume import TsdfVolume

    with open_arrays(subjects("adaptive map").path) as found:
        content = {name: np.array(found[name]) for name in found}
    content[array] = change(content[array])
    np.savez(tmp_path / "map.npz", **content)
    refused(lambda: TsdfVolume.load(tmp_path / "map.npz"), MapError)


def test_an_archive_of_arrays_that_is_a_bomb(tmp_path):
    header = "{'descr': '|u1', 'fortran_order': False, 'shape': (300000000,), }"
    path = npz(tmp_path / "map.npz", {"format": npy(header, bytes(300_000_000))})
    assert path.stat().st_size < 400_000
    from dudmap.core.map.volume import TsdfVolume

    refused(lambda: TsdfVolume.load(path), MapError, "unpack to 300000")


@pytest.mark.parametrize(
    ("descr", "shape", "match"),
    [("'<f4'", "(1000000000, 1000)", "declares"), ("'|O'", "(1,)", "expected numbers"),
     ("[('a', '|O')]", "(1,)", "expected numbers"), ("'<U0'", "(1000000000000,)", "expected numbers"),
     ("'<f4'", "(-1,)", "whole numbers"), ("'<f4'", "(1.5,)", "."), ("__import__('os')", "()", "malformed")],
)  # fmt: skip
def test_arrays_that_declare_more_than_they_hold(descr, shape, match, tmp_path):
    data = npy(f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}", bytes(8))
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(ValueError, match=match):
        load_array(tmp_path / "a.npy")
    with open_arrays(npz(tmp_path / "a.npz", {"x": data})) as arrays, pytest.raises(ValueError, match=match):
        arrays["x"]


def test_arrays_are_what_numpy_saved(tmp_path):
    arrays = {
        "a": np.arange(24.0).reshape(2, 3, 4), "b": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "c": np.array("text"), "d": np.zeros((0, 3), np.float16), "e": np.array(3.5), "f": np.array([True, False]),
    }  # fmt: skip
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    with open_arrays(tmp_path / "a.npz") as found:
        assert set(found) == set(arrays)
        for name, array in arrays.items():
            assert found[name].dtype == array.dtype
            np.testing.assert_array_equal(found[name], array)
            assert found[name].flags.writeable
