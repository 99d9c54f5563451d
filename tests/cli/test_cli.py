"""The command line: one sentence and an exit code for every mistake, never a traceback."""

import json
import subprocess
import sys
import tomllib

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import dudmap
from dudmap.cli import COMMANDS, app
from dudmap.cli.config import commented
from dudmap.config import Config
from dudmap.core.geometry.trajectory import Trajectory
from recordings import HEIGHT, WIDTH, cut, write_recording


@pytest.fixture
def recording(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return write_recording(tmp_path / "desk", 6)


def call(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def sentence_of(*arguments, code=1):
    """The one sentence on stderr of a call that fails."""
    result = call(*arguments)
    assert result.exit_code == code, result.output
    lines = result.stderr.strip().splitlines()
    assert lines[-1].startswith("dudmap: "), result.stderr
    assert "Traceback" not in result.output
    return lines[-1]


# -- the frame around the commands ------------------------------------------------------------------------------------


HEAVY = ("numpy", "cv2", "numba", "scipy", "matplotlib", "trimesh", "pydantic")


def test_help_loads_nothing_heavy_and_lists_every_command():
    script = f"""
import atexit, sys, dudmap.cli
atexit.register(lambda: print([name for name in {HEAVY} if name in sys.modules], file=sys.stderr))
sys.argv = ["dudmap", "--help"]
dudmap.cli.main()
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stderr.strip() == "[]"
    for name, line in COMMANDS.items():
        assert name in result.stdout
        assert line[:30] in result.stdout


def test_import_dudmap_loads_nothing_heavy():
    script = "import sys, dudmap; print([m for m in ('numpy', 'cv2', 'numba', 'rich', 'typer') if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_every_command_exists_and_explains_itself():
    for name in COMMANDS:
        result = call(name, "--help")
        assert result.exit_code == 0, name
        assert "--help" in result.stdout


def test_version():
    result = call("--version")
    assert result.exit_code == 0
    assert result.stdout.strip() == f"dudmap {dudmap.__version__}"


def test_wrong_usage_is_exit_code_2(recording):
    for arguments in (["nonsense"], ["run"], ["run", recording, "--nonsense"], ["run", recording, "--max-frames", "0"]):
        assert call(*arguments).exit_code == 2


# -- config -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("system", ["dudmap", "thesis"])
def test_config_prints_toml_that_reads_back(system, tmp_path):
    result = call("config", "--system", system)
    assert result.exit_code == 0
    assert Config.from_tree(tomllib.loads(result.stdout)) == Config.from_tree({"system": system})


def test_config_explains_every_parameter():
    lines = commented(Config()).splitlines()
    for number, line in enumerate(lines):
        if " = " in line and not line.startswith("#"):
            assert lines[number - 1].startswith("# "), line


def test_config_of_an_unknown_system():
    assert "system = 'fancy' is not acceptable" in sentence_of("config", "--system", "fancy")


# -- run --------------------------------------------------------------------------------------------------------------


def test_run_writes_a_run_folder_and_prints_a_table(slam, recording, tmp_path):
    result = call("run", recording, "--save-masks", "--max-frames", 4)
    assert result.exit_code == 0, result.output
    out = tmp_path / "runs" / "desk"
    assert len(Trajectory.load(out / "trajectory.txt")) == 4
    assert len(list((out / "masks").iterdir())) == 4
    assert "tracked" in result.stdout
    assert "written to runs/desk" in result.stdout.replace("\n", "")


def test_run_does_not_overwrite_an_earlier_one_unasked(slam, recording, tmp_path):
    for name in ("desk", "desk-2", "desk-3"):
        assert call("run", recording, "--quiet").exit_code == 0
        assert (tmp_path / "runs" / name / "metrics.json").exists()
    assert call("run", recording, "--quiet", "--out", "runs/desk").exit_code == 0
    assert not (tmp_path / "runs" / "desk-4").exists()


def test_json_is_one_object_on_stdout(slam, recording):
    slam.script = {2: "lost"}
    result = call("run", recording, "--json")
    metrics = json.loads(result.stdout)
    assert metrics["lost"] == 1
    assert "frame 2: lost" in result.stderr


def test_quiet_prints_nothing(slam, recording):
    result = call("run", recording, "--quiet")
    assert result.output == ""


def test_parameters_come_from_file_and_single_assignments(slam, recording, tmp_path):
    (tmp_path / "my.toml").write_text("[volume]\nvoxel_size = 0.02\n")
    call("run", recording, "--config", "my.toml", "--set", "tracker.huber=0.03", "--out", "a")
    used = Config.load("a/config.toml")
    assert (used.volume.voxel_size, used.tracker.huber) == (0.02, 0.03)
    assert "the system thesis has no parameter volume.voxel_size" in sentence_of(
        "run", recording, "--config", "my.toml", "--system", "thesis"
    )


@pytest.mark.parametrize(
    ("option", "says"),
    [
        (["--passes", "2"], "second pass"),
        (["--max-memory", "1GB"], "memory limit"),
        (["--masks", "desk/rgb"], "given masks"),
        (["--set", "tracker.huber=0.02"], "tracker.huber"),
    ],
)
def test_the_system_of_the_thesis_names_options_that_it_does_not_have(recording, option, says):
    assert f"no {says}" in sentence_of("run", recording, "--system", "thesis", *option).replace("parameter ", "")


def test_what_was_calibrated_beforehand_is_not_estimated_again(slam, recording):
    call("run", recording, "--out", "live", "--live")
    assert Config.load("live/config.toml").sensor.self_calibration
    call("run", recording, "--out", "a")
    assert not Config.load("a/config.toml").sensor.self_calibration
    call("run", recording, "--out", "b", "--calibration", "given")
    assert not Config.load("b/config.toml").sensor.self_calibration
    call("run", recording, "--out", "c", "--calibration", "a/calibration.toml")
    assert not Config.load("c/config.toml").sensor.self_calibration


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--set", "voxel_size=0.01"], "unknown configuration key 'voxel_size'; the nearest known key is 'volume"),
        (["--set", "tracker.hubber=1"], "the nearest known key is 'tracker.huber'"),
        (["--set", "volume.voxel_size=0"], "volume.voxel_size = 0 is not acceptable"),
        (["--set", "volume.voxel_size=-1"], "volume.voxel_size = -1 is not acceptable"),
        (["--set", "volume.voxel_size"], "expected key=value"),
        (["--config", "missing.toml"], "cannot read the configuration missing.toml"),
        (["--system", "fancy"], "system = 'fancy' is not acceptable"),
        (["--camera", "1,2,3"], "expected fx,fy,cx,cy"),
        (["--camera", "500,500,320,240,640,480"], "640x480 pixels, but the recording's depth images are 64x48"),
        (["--out", "desk/rgb.txt"], "desk/rgb.txt lies in the recording "),
        (["--out", "/proc/dudmap"], "cannot write into the run folder /proc/dudmap"),
    ],
)  # fmt: skip
def test_arguments_that_cannot_be_used(slam, recording, arguments, sentence):
    assert sentence in sentence_of("run", recording, *arguments)


def spoil_missing(folder):
    return folder.with_name("nowhere")


def spoil_empty(folder):
    empty = folder.with_name("empty")
    empty.mkdir()
    return empty


def spoil_result(folder):
    result = folder.with_name("result")
    (result / "thumbnails").mkdir(parents=True)
    for name in ("metrics.json", "trajectory.txt", "thumbnails/1.0.color.jpg"):
        (result / name).touch()
    return result


def spoil_times(folder):
    (folder / "rgb.txt").write_text("900.0 rgb/0.png\n")


def spoil_nan(folder):
    (folder / "depth.txt").write_text("nan depth/0.png\n")


def spoil_order(folder):
    (folder / "depth.txt").write_text("2 depth/0.png\n1 depth/1.png\n")


def spoil_all_depth(image):
    def spoil(folder):
        for path in (folder / "depth").iterdir():
            cv2.imwrite(str(path), image)

    return spoil


def spoil_all_truncated(folder):
    for path in (folder / "depth").iterdir():
        cut(path)


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (spoil_missing, "there is no folder"),
        (spoil_empty, "is empty; expected a recording"),
        (spoil_result, "is the result of a run; expected a recording (dudmap view shows results)"),
        (spoil_times, "no colour image lies within 20 ms of a depth image"),
        (spoil_nan, "depth.txt, line 1: the timestamp 'nan' is not a finite number"),
        (spoil_order, "depth.txt, line 2: the timestamp 1.000000 comes after 2.000000"),
        (spoil_all_depth(np.full((HEIGHT, WIDTH), 9, np.uint8)), "holds uint8 values; expected 16 bit or float"),
        (spoil_all_depth(np.full((24, 32), 9, np.uint16)), "both must have one size"),
        (spoil_all_depth(np.zeros((HEIGHT, WIDTH), np.uint16)), "holds no reading, all its pixels are zero"),
        (spoil_all_truncated, "is cut off"),
    ],
)
def test_recordings_that_cannot_be_used(slam, recording, spoil, sentence):
    folder = spoil(recording) or recording
    assert sentence in sentence_of("run", folder)
    assert not recording.with_name("runs").exists()


def test_a_truncated_image_in_the_middle_is_skipped_and_counted(slam, recording):
    cut(recording / "depth/2.png")
    result = call("run", recording, "--json")
    assert result.exit_code == 0
    assert "skipped: frame 2" in result.stderr
    metrics = json.loads(result.stdout)
    assert (metrics["frames"], metrics["tracked"], metrics["unreadable"]) == (6, 5, 1)


def test_what_looks_wrong_is_said_before_the_run(slam, recording):
    result = call("run", recording, "--camera", "60,90,31.5,23.5", "--json")
    assert result.exit_code == 0
    assert "warning: the intrinsics of the depth camera look wrong: focal lengths of 60 and 90" in result.stderr
    assert json.loads(result.stdout)["frames"] == 6


def test_ctrl_c_saves_and_says_so(slam, recording):
    slam.script = {3: KeyboardInterrupt()}
    said = sentence_of("run", recording, "--out", "out", code=130)
    assert said == (
        "dudmap: interrupted after 3 frames; the trajectory and the map up to there are in out; "
        "dudmap run --resume out goes on"
    )
    assert len(Trajectory.load("out/trajectory.txt")) == 3


def test_an_error_of_the_system_is_one_sentence(slam, recording):
    slam.script = {3: PermissionError(13, "Permission denied", "somewhere")}
    assert sentence_of("run", recording, "--out", "out") == "dudmap: somewhere: Permission denied"


def test_no_frame_tracked_is_a_failure(slam, recording):
    slam.script = dict.fromkeys(range(6), "lost")
    assert "none of the 6 frames could be tracked" in sentence_of("run", recording)
