"""Commands that read a run folder: incomplete, of a newer version, without triangles, to an unknown format."""

import json
import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

from dudmap.cli import app
from dudmap.core.geometry.mesh import Mesh
from dudmap.io.exporting.exporters import EXPORTERS
from exported_runs import make_run
from run_folders import write_run

READING = {
    "export": ["export", "RUN", "--out", "out.ply"],
    "render": ["render", "RUN", "--orbit", "--max-frames", "2", "--out", "out.avi"],
    "clean": ["clean", "recording", "out", "--run", "RUN"],
    "report": ["report", "RUN"],
    "view": ["view", "RUN"],
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    make_run(folder, frames=3)
    write_run(folder / "whole", complete=True)
    for name in ("map.npz", "masks"):
        source = folder / "run" / name
        (shutil.copytree if source.is_dir() else shutil.copy)(source, folder / "whole" / name)
    return folder


@pytest.fixture
def where(made, tmp_path, monkeypatch):
    shutil.copytree(made, tmp_path / "copy")
    monkeypatch.chdir(tmp_path / "copy")
    return tmp_path / "copy"


def sentence(words, run="whole"):
    """The one sentence of a call that fails."""
    done = CliRunner().invoke(app, [run if word == "RUN" else word for word in words])
    assert done.exit_code == 1, done.output
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("dudmap: ")
    return line


@pytest.mark.parametrize("name", READING)
def test_a_run_of_a_newer_version(where, name):
    tree = json.loads((where / "whole" / "metrics.json").read_text())
    tree["versions"]["dudmap"] = "999.0.0"
    (where / "whole" / "metrics.json").write_text(json.dumps(tree))
    assert "was written by dudmap 999.0.0" in sentence(READING[name])


@pytest.mark.parametrize("name", READING)
def test_an_empty_folder(where, name):
    (where / "empty").mkdir()
    line = sentence(READING[name], "empty")
    assert "empty" in line
    assert "run" in line


MISSING = {
    "export": ("mesh.ply", "holds no mesh.ply"), "render": ("map.npz", "holds no map.npz"),
    "clean": ("masks", "repeat the run with --save-masks"), "report": ("metrics.json", "metrics.json"),
    "view": ("metrics.json", "metrics.json"),
}  # fmt: skip


@pytest.mark.parametrize("name", MISSING)
def test_a_run_that_was_cut_off(where, name):
    file, expected = MISSING[name]
    path = where / "whole" / file
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert expected in sentence(READING[name])


def test_a_mesh_without_triangles(where):
    points = np.zeros((3, 3), np.float32)
    Mesh(points, np.empty((0, 3), np.int32), points.astype(np.uint8), points).save(where / "whole" / "mesh.ply")
    for target in ("out.ply", "out.glb", "out.pcd", "out.npz"):
        assert "has no triangles, so there is nothing to export" in sentence(["export", "whole", "--out", target])
    done = CliRunner().invoke(app, ["report", "whole"])
    assert done.exit_code == 0, done.output  # the report shows the rest
    assert '"mesh": null' in (where / "whole" / "report.html").read_text(encoding="utf-8")


def test_an_unknown_ending_lists_the_known_ones(where):
    line = sentence(["export", "whole", "--out", "map.blend"])
    assert all(name in line for name in EXPORTERS)
    assert "the ending must be one of .mp4, .avi" in sentence(["render", "whole", "--orbit", "--out", "map.mov"])
