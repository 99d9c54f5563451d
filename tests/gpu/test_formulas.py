"""The formulas that Numba and Warp compile from one text give the same numbers."""

import numpy as np
import pytest

from dudmap.core.backends.device import make_backend

wp = pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")
make_backend("warp-cpu")

from dudmap.core.backends import parameters
from dudmap.core.backends.warp.kernels import formulas
from dudmap.core.backends.warp.kernels.structs import FusionParameters, struct
from dudmap.core.formulas import residual, voxel

PARAMETERS = parameters.FusionParameters(
    parameters.TruncationBand(0.04, 0.04, 3.0, 0.3, parameters.SensorNoise(0.001, 0.0019)),
    voxel_size=0.01, sdf_unit=0.3 / 32767, depth_unit=6 / 65534, max_weight=255, max_readings=48, carve_rate=4,
    depth_min=0.05, depth_max=6.0,
)  # fmt: skip
Words, Numbers = wp.array(dtype=wp.int32), wp.array(dtype=wp.float32)


@wp.kernel
def fuse_all(
    words: Words, readings: Words, paints: Words, depths: Numbers, p: FusionParameters,
    out: wp.array2d(dtype=wp.int32), shares: Numbers,
):  # fmt: skip
    n = wp.tid()
    word, share = formulas.fuse_voxel(
        words[n], readings[n], paints[n], depths[n], wp.float32(1.0), wp.float32(1.0) / p.sdf_unit, p
    )
    out[n, 0] = word
    out[n, 1] = formulas.fuse_color(words[n] & 0x3FFFFFFF, paints[n], share)
    shares[n] = share


@wp.kernel
def blend_all(corners: wp.array2d(dtype=wp.float32), out: wp.array2d(dtype=wp.float32)):
    n = wp.tid()
    value, gx, gy, gz = formulas.trilinear(
        corners[n, 0], corners[n, 1], corners[n, 2], corners[n, 3], corners[n, 4], corners[n, 5], corners[n, 6],
        corners[n, 7], corners[n, 8], corners[n, 9], corners[n, 10],
    )  # fmt: skip
    out[n, 0] = value
    out[n, 1] = gx
    out[n, 2] = gy
    out[n, 3] = gz


def test_fused_voxels_are_equal():
    """Words of distance, weight and intensity differ nowhere by more than the last step, and in fewer than one of a
    thousand voxels at all: where a rounding lies on the border between two steps."""
    random, n = np.random.default_rng(1), 20000
    words = random.integers(-(2**31), 2**31, n).astype(np.int32)
    words[: n // 4] = 0  # never observed
    depths = random.uniform(0.3, 5.5, n).astype(np.float32)
    near = np.clip(depths + random.normal(0, 0.05, n), 0.1, 6)
    steps = (near / PARAMETERS.depth_unit).astype(np.int64)
    readings = (steps << 16 | (0.95 * steps).astype(np.int64)).astype(np.uint32).view(np.int32)
    readings[random.random(n) < 0.1] = 0  # no reading
    paints = random.integers(-(2**31), 2**31, n).astype(np.int32)
    p, one = parameters.single(PARAMETERS), np.float32(1)
    expected, colors = np.empty(n, np.int32), np.empty(n, np.int32)
    shares = np.empty(n, np.float32)
    for k in range(n):
        expected[k], shares[k] = voxel.fuse_voxel(words[k], readings[k], paints[k], depths[k], one, one / p.sdf_unit, p)
        colors[k] = voxel.fuse_color(np.int32(words[k] & 0x3FFFFFFF), paints[k], shares[k])
    found, found_shares = wp.zeros((n, 2), dtype=wp.int32, device="cpu"), wp.zeros(n, dtype=wp.float32, device="cpu")
    arrays = [wp.array(array, device="cpu") for array in (words, readings, paints, depths)]
    wp.launch(fuse_all, dim=n, inputs=[*arrays, struct(PARAMETERS), found, found_shares], device="cpu")
    assert 0.2 < (expected != words).mean() < 0.9
    different = found.numpy()[:, 0] != expected
    assert different.mean() < 1e-3
    for shift, mask in ((16, 0xFFFF), (8, 0xFF), (0, 0xFF)):
        assert np.abs((found.numpy()[:, 0] >> shift & mask) - (expected >> shift & mask)).max() <= 1
    np.testing.assert_allclose(found_shares.numpy(), shares, rtol=1e-6)
    assert (found.numpy()[:, 1] != colors).mean() < 1e-3


def test_interpolations_are_equal():
    corners = np.random.default_rng(2).uniform(0, 1, (500, 11)).astype(np.float32)
    out = wp.zeros((500, 4), dtype=wp.float32, device="cpu")
    wp.launch(blend_all, dim=500, inputs=[wp.array(corners, device="cpu"), out], device="cpu")
    np.testing.assert_allclose(out.numpy(), [residual.trilinear(*row) for row in corners], atol=1e-6)
