"""The weight of a residual: against plain NumPy, and that its text stands in one place."""

import ast
from pathlib import Path

import numpy as np

import dudmap
from dudmap.core.backends.parameters import RegistrationParameters, SensorNoise, TruncationBand
from dudmap.core.formulas.residual import residual_weights

BAND = TruncationBand(0.05, 0.05, 3.0, 0.3, SensorNoise(0.001, 0.0019))


def test_weights_are_those_of_the_thesis():
    """Equations 4.44 and 4.46, with the noise of the sensor (3.91)."""
    rng, p = np.random.default_rng(1), RegistrationParameters(BAND, 0.01, 0.13, 0.1, 0.0029)
    z = rng.uniform(0.5, 4, (20, 30)).astype(np.float32)
    r, rc = rng.normal(0, 0.02, z.shape).clip(-0.04, 0.04), rng.normal(0, 0.2, z.shape)
    rc[3] = np.nan
    static = rng.uniform(0, 1, z.shape)
    of_distance, of_intensity, square = residual_weights(z, np.stack([r, rc]).astype(np.float32), static, p)
    scale = np.minimum(0.0029 / (0.001 + 0.0019 * z**2), 1)
    a, known = np.abs(r * scale), np.isfinite(rc)
    robust = np.minimum(0.01 / a, 1)
    np.testing.assert_allclose(of_distance, np.where(known, static * robust * scale**2, 0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(square, np.where(known, static * robust * a**2, 0), rtol=1e-4, atol=1e-9)
    expected = np.where(known, static * 0.13 * np.minimum(0.1 / np.abs(rc), 1), 0)
    np.testing.assert_allclose(of_intensity, expected, rtol=1e-4)


OWNERS = {
    ("huber", "color_huber", "sigma_at_reference"): {
        "core/formulas/residual.py",
        "core/tracking/tracker.py:parameters",  # hands them on
        "fleet/sdf_alignment.py:align_maps",  # differences of two maps, without a reading or its noise
    },
    ("sigma_base", "sigma_scale"): {
        "config.py:sigma",
        "core/map/volume.py:fusion_parameters",  # hands them on, as do all that follow
        "core/dynamics/detector.py:noise_parameters",
        "core/calibration/adjustment.py:__init__",
    },
    ("noise.base", "noise.scale"): {
        "core/formulas/pixel.py",
        "core/backends/cpu/evidence.py:weigh_readings",  # hand them on
        "core/backends/cpu/reprojection.py:compare_images",
    },
}
"""Parameters of a formula, and the files or functions that may name them; everybody else calls the formula."""


def test_each_formula_stands_in_one_place():
    root = Path(dudmap.__file__).parent
    found = {names: set() for names in OWNERS}
    for path in sorted(root.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if not any(name in text for names in OWNERS for name in names):
            continue
        for part in ast.walk(ast.parse(text)):
            if isinstance(part, ast.FunctionDef):
                nodes = [node for node in ast.walk(part) if isinstance(node, ast.Attribute)]
                used = {node.attr for node in nodes} | {".".join(ast.unparse(node).split(".")[-2:]) for node in nodes}
                for names in OWNERS:
                    if used & {*names}:
                        found[names].add(f"{path.relative_to(root).as_posix()}:{part.name}")
    for names, owners in OWNERS.items():
        others = {place for place in found[names] if not {place, place.partition(":")[0]} & owners}
        assert not others, "these name the parameters of a formula; call weigh, residual_weights or sigma instead"
