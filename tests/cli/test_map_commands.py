"""Commands on saved maps: what is asked for is passed on, and bad input is one sentence before anything is written."""

from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from dudmap.cli import app
from dudmap.config import Config
from dudmap.core.places.saved_map import SavedMap
from recordings import write_recording


@pytest.fixture
def recording(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return write_recording(tmp_path / "desk", 4)


@pytest.fixture
def saved(tmp_path, monkeypatch):
    """A run folder whose map is never read."""
    folder = tmp_path / "earlier"
    folder.mkdir()
    Config().override(["volume.voxel_size=0.03"]).save(folder / "config.toml")
    asked, the_map = [], SimpleNamespace(folder=folder)
    monkeypatch.setattr(SavedMap, "load", classmethod(lambda cls, *arguments: asked.append(arguments) or the_map))
    return folder, asked


def sentence(*arguments):
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == 1
    assert done.stderr.count("\n") == 1
    return done.stderr


def test_a_run_goes_on_in_a_map_with_its_configuration(slam, recording, saved, tmp_path):
    folder, asked = saved
    made = []
    start = slam.__init__

    def remember(self, *arguments, **options):
        made.append((arguments, options))
        start(self, *arguments, **options)

    slam.__init__ = remember
    options = ["--calibration", "given", "--quiet", "--out", str(tmp_path / "next")]
    done = CliRunner().invoke(app, ["run", str(recording), "--map", str(folder), "--localize", *options])
    assert done.exit_code == 0, done.stderr
    assert asked == [(folder, 0.03)]
    (_, config), given = made[0]
    assert config.volume.voxel_size == 0.03
    assert (given["saved_map"].folder, given["localize"]) == (folder, True)
    written = {path.name for path in (tmp_path / "next").iterdir()}
    assert "trajectory.txt" in written
    assert not written & {"map.npz", "keyframes.npz", "mesh.ply"}


def test_maps_that_cannot_be_used(slam, recording, tmp_path):
    (tmp_path / "empty").mkdir()
    assert "there is nothing to localize in; name the run folder" in sentence("run", recording, "--localize")
    assert "holds no map.npz and no keyframes.npz" in sentence("run", recording, "--map", "empty")
    assert "which is emptied; name another" in sentence("run", recording, "--map", "empty", "--out", "empty")
    off = ("--set", "relocalization.enabled=false")
    assert "drop relocalization.enabled=false" in sentence("run", recording, "--map", "empty", *off)
    assert "holds no map.npz and no keyframes.npz" in sentence("merge", "empty", "desk")
    assert "is one of the runs to be merged" in sentence("merge", "empty", "desk", "--out", "empty")
    assert "is named twice" in sentence("merge", "empty", "desk", "empty", "--out", "world")
    assert "holds no map.npz and no keyframes.npz" in sentence("merge", "empty", "desk", "--world", "--out", "world")
    message = sentence("export", "empty", "--out", "run.txt")
    assert "must be one of" in message
    assert ".mcap" in message
    assert not (tmp_path / "runs").exists()


def test_two_passes_and_a_map_exclude_each_other(slam, recording, saved):
    assert "with a saved map, which is kept" in sentence(
        "run", recording, "--map", saved[0], "--passes", "2", "--calibration", "given"
    )
