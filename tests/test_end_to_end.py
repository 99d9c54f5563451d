"""The whole way with the real system: the demo, a real excerpt, and the same answer twice."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from dudmap.app.pipeline.run import run
from dudmap.cli import app
from dudmap.config import Config
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.map.volume import TsdfVolume
from dudmap.io.sequences import open_sequence

EXCERPT = Path(__file__).parent / "fixtures" / "freiburg1_xyz"


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """Run folder and metrics of the demo, cut after the person has crossed half of the room."""
    out = tmp_path_factory.mktemp("demo")
    command = [sys.executable, "-m", "dudmap", "demo", "--max-frames", "60", "--out", str(out), "--json"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)  # peak memory of a process of its own
    assert result.returncode == 0, result.stderr
    return out, json.loads(result.stdout)


def test_the_demo_is_accurate(demo):
    _, metrics = demo
    assert metrics["frames"] == metrics["tracked"] == 60
    assert metrics["lost"] == 0
    assert metrics["ate_rmse_m"] <= 0.01
    assert metrics["mask_iou_frames"] >= 10
    assert metrics["mask_iou_mean"] >= 0.85
    assert metrics["peak_rss_mb"] <= 2000


def test_the_demo_leaves_a_run_folder_with_a_picture(demo):
    out, metrics = demo
    assert len(Trajectory.load(out / "trajectory.txt")) == 60
    assert len(list((out / "masks").glob("*.png"))) == 60
    mesh = Mesh.load(out / "mesh.ply")
    assert (len(mesh.vertices), len(mesh.faces)) == (metrics["mesh_vertices"], metrics["mesh_triangles"])
    assert TsdfVolume.load(out / "map.npz").num_blocks == metrics["map_blocks"]
    picture = cv2.imread(str(out / "demo.png"))
    assert picture.shape[0] > 500
    assert picture.std() > 20


@pytest.mark.parametrize("system", ["dudmap", "thesis"])
def test_a_real_excerpt_is_tracked(tmp_path, system):
    report = run(open_sequence(EXCERPT), Config.from_tree({"system": system}), tmp_path, progress=False)
    assert report.metrics["tracked"] == 12
    assert report.metrics["ate_rmse_m"] <= 0.012
    assert report.metrics["mesh_triangles"] > 10_000


def test_the_same_input_twice_gives_the_same_files(tmp_path):
    sequence = open_sequence(EXCERPT)
    for name in ("a", "b"):
        run(sequence, Config(), tmp_path / name, max_frames=6, save_masks=True, progress=False)
    names = ["trajectory.txt", "mesh.ply", "config.toml"]
    names += [f"masks/{path.name}" for path in (tmp_path / "a/masks").iterdir()]
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    with np.load(tmp_path / "a/map.npz") as a, np.load(tmp_path / "b/map.npz") as b:
        for key in a.files:
            np.testing.assert_array_equal(a[key], b[key], err_msg=key)


def test_warmup_goes_through_every_part():
    result = CliRunner().invoke(app, ["warmup"])
    assert result.exit_code == 0, result.output
    for part in ("synthetic frames", "tracking, labels and map", "mesh", "view", "map file", "ready after"):
        assert part in result.output
