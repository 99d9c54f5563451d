"""The last line of a useless run names the cause and a remedy; the exit code is 3."""

import json
from typing import Any

import pytest
from typer.testing import CliRunner

from dudmap.app.pipeline.usefulness import uselessness
from dudmap.cli import app
from recordings import write_recording

GOOD = {
    "frames": 60, "tracked": 58, "fused": 50, "mesh_triangles": 4000, "warnings": [],
    "readings": {"too_near": 0.0, "too_far": 0.02}, "lost_frames": [{"reason": "too few inliers"}] * 2,
}  # fmt: skip
LIMITS = 0.2, 6.0


def call(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def lost(reason, count):
    return [{"reason": reason}] * count


@pytest.mark.parametrize(
    ("poses", "change", "said"),
    [
        (1, {"lost_frames": lost("only 12% fall on the map", 40) + lost("only 9% fall on the map", 19)},
         ("1 of 60 frames", "59 of 59 lost frames for one reason: only 12% fall", "dudmap info")),
        (2, {"frames": 400, "warnings": ["the times look wrong"]}, ("2 of 400", "first mend the recording: the times")),
        (50, {"mesh_triangles": 0, "fused": 0, "lost_frames": []},
         ("mesh is empty", "0 of 58 tracked frames were fused")),
        (3, {"readings": {"too_near": 0.9, "too_far": 0.0}}, ("90% of the depth readings are nearer than 0.2 m",
         "--range near")),
        (3, {"readings": {"too_near": 0.0, "too_far": 0.7}}, ("farther than 6 m", "--range far")),
    ],
)  # fmt: skip
def test_why_and_what_to_try(poses, change, said):
    sentence = uselessness(GOOD | change, poses, LIMITS)
    assert sentence is not None
    assert sentence.startswith("this run is of no use: ")
    assert [part for part in said if part not in sentence] == []


def test_a_run_that_lost_much_is_of_use():
    assert uselessness(GOOD, 58, LIMITS) is None
    assert uselessness(GOOD, 6, LIMITS) is None  # a tenth


@pytest.mark.parametrize("command", ["run", "live"])
def test_the_exit_code_and_the_files(slam, tmp_path, command):
    slam.script = dict.fromkeys(range(1, 12), "lost")
    folder = write_recording(tmp_path / "desk", 12)
    name = f"replay:{folder}" if command == "live" else folder
    done = call(command, name, "--out", tmp_path / "out", "--json")
    assert done.exit_code == 3
    metrics = json.loads(done.stdout)
    assert metrics["useless"].startswith("this run is of no use: 1 of 12 frames")
    assert done.stderr.strip().splitlines()[-1] == f"dudmap: {metrics['useless']}"
    for file in ("trajectory.txt", "mesh.ply", "metrics.json", "config.toml"):
        assert (tmp_path / "out" / file).is_file()
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["complete"]


def test_a_localisation_asks_which_frames_are_lost(slam, tmp_path, monkeypatch):
    from dudmap.app.pipeline.run import run
    from dudmap.config import Config
    from dudmap.core.places.saved_map import SavedMap
    from dudmap.io.sequences import open_sequence

    slam.script = dict.fromkeys(range(1, 12), "lost")
    sequence = open_sequence(write_recording(tmp_path / "desk", 12))
    known: Any = SavedMap
    saved = known(None, [], None)
    report = run(sequence, Config(), tmp_path / "out", progress=False, localize=True, saved_map=saved)
    assert report.metrics["useless"] is None
