"""The report holds what the run folder holds, needs nothing else, and says what is missing."""

import base64
import gzip
import json
import re
from datetime import datetime
from html.parser import HTMLParser
from itertools import pairwise

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from dudmap.app.pipeline.run import run
from dudmap.app.viewing.plots import plots
from dudmap.app.viewing.report import NUMBER, ReportObserver, Thumbnails, write_report
from dudmap.app.viewing.run_files import RunFiles
from dudmap.cli import app
from dudmap.config import Config
from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DudmapError
from dudmap.io.sequences import open_sequence
from fake_slam import fake_result
from recordings import write_recording
from run_folders import FRAMES, stamp, wall, write_run


class Page(HTMLParser):
    """Elements, attributes and texts of a page."""

    VOID = ("meta", "img", "input", "br", "link")

    def __init__(self, text):
        super().__init__()
        self.tags, self.by_id, self.texts, self._open = [], {}, [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.tags.append((tag, values))
        if tag not in self.VOID:
            self._open.append((tag, values.get("id")))

    def handle_endtag(self, tag):
        while self._open and self._open.pop()[0] != tag:
            pass

    def handle_data(self, data):
        self.texts.append(data)
        if self._open and self._open[-1][1]:
            self.by_id[self._open[-1][1]] = self.by_id.get(self._open[-1][1], "") + data


@pytest.fixture(scope="module")
def text(tmp_path_factory):
    folder = write_run(tmp_path_factory.mktemp("report") / "run")
    assert write_report(folder) == folder / "report.html"
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(text):
    return Page(text)


def test_the_page_loads_nothing(page):
    for tag, values in page.tags:
        for key in ("src", "href", "action", "poster"):
            assert (values.get(key) or "data:").startswith(("data:", "#")), (tag, key)
        assert tag not in ("link", "iframe", "object", "embed")
        assert tag != "script" or "src" not in values


def test_the_page_carries_the_licence_of_what_it_ships(text):
    assert "Permission is hereby granted, free of charge" in text
    assert "three.js authors" in text


def test_the_mesh_is_that_of_the_run(page):
    about = json.loads(page.by_id["run"])["mesh"]
    data = gzip.decompress(base64.b64decode(page.by_id["mesh"]))
    n, m = about["vertices"], about["triangles"]
    whole = np.frombuffer(data, "<u2", 3 * n).reshape(-1, 3)
    low, high = np.array(about["low"]), np.array(about["high"])
    colors = np.frombuffer(data, np.uint8, 3 * n, 6 * n).reshape(-1, 3)
    steps = np.frombuffer(data, "<i4", 3 * m, -(-9 * n // 4) * 4)
    mesh = wall()
    np.testing.assert_allclose(low + whole / 65535 * (high - low), mesh.vertices, atol=1e-4)
    np.testing.assert_array_equal(colors, mesh.colors)
    np.testing.assert_array_equal(np.cumsum(steps).reshape(-1, 3), mesh.faces)


def test_the_scene_has_every_tracked_frame_and_what_moves(page):
    scene = json.loads(page.by_id["run"])
    tracked = [k for k in range(FRAMES) if k != 3]
    np.testing.assert_allclose(scene["times"], [stamp(k) for k in tracked])
    np.testing.assert_allclose([pose[0] for pose in scene["poses"]], 0.05 * np.array(tracked), atol=1e-6)
    np.testing.assert_allclose([pose[3:] for pose in scene["poses"]], [[0, 0, 0, 1]] * len(tracked), atol=1e-6)
    moving = {stamp(k): movers for k, movers in zip(tracked, scene["movers"], strict=True) if movers}
    assert {t: [m["id"] for m in movers] for t, movers in moving.items()} == {stamp(5): [4]}
    assert scene["camera"]["fx"] == 60


def test_the_images_are_those_of_the_run(page):
    images = [values for tag, values in page.tags if tag == "img"]
    assert len(images) == 6  # colour and mask of frames 0, 4 and 8
    for k, values in zip((0, 4, 8), images[::2], strict=True):
        data = base64.b64decode(values["src"].removeprefix("data:image/jpeg;base64,"))
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image.shape == (48, 64, 3)
        assert abs(image.mean() - k) < 3
    figures = [values for tag, values in page.tags if tag == "figure" and "data-t" in values]
    assert all(values["data-depth"].startswith("data:image/jpeg") for values in figures)


def test_figures_configuration_plots_and_losses_are_there(page, text):
    said = " ".join(page.texts)
    assert "11 of 12 frames were tracked" in said
    assert "1 lost: too few inliers <b>" in said  # escaped in the text of the page
    assert "unreadable: frame 7: the image is cut off" in said
    assert "2 redundant views" in said
    assert 'preset = "default"' in said
    assert text.count("<svg") == 3
    for title in ("Trajectory seen from above", "Share of the readings", "Residuals"):
        assert title in said
    assert ">0.1</text>" in text  # the densities of the residuals are numbers
    assert "mathdefault" not in text


def rows(page):
    """Texts of the cells of the tables, in pairs."""
    cells = [text for text in page.texts if text.strip()]
    return dict(pairwise(cells))


def test_metrics_have_names_and_units(tmp_path):
    metrics = {
        "ate_rmse_m": 0.0123, "rpe_rot_rmse_deg_per_s": 0.456, "map_bytes": 2_500_000, "peak_rss_mb": 691.3,
        "readings": {"too_near": 0.01, "too_far": 0.25}, "command": "dudmap run desk --max-frames 12",
        "date": "2026-11-28 21:40:13+00:00",
    }  # fmt: skip
    found = rows(Page(write_report(write_run(tmp_path / "run", **metrics)).read_text(encoding="utf-8")))
    assert found["absolute trajectory error (ATE), RMSE"] == "12.3 mm"
    assert found["relative error (RPE) over one second, rotation, RMSE"] == "0.46 deg"
    assert found["size of the map"] == "2.5 MB"
    assert found["per frame, median"] == "41.2 ms"
    assert found["readings beyond the depth range"] == "25.0 %"
    assert found["command"] == metrics["command"]
    assert found["finished"] == metrics["date"]
    assert not set(found) & set(metrics) - {"command"}


def test_times_per_stage_are_the_parts_of_one_bar(tmp_path):
    folder = write_run(tmp_path / "run")
    lines = (folder / "timings.csv").read_text().splitlines()
    lines = [lines[0] + ",movers", *(f"{line},6" for line in lines[1:])]
    (folder / "timings.csv").write_text("\n".join(lines) + "\n")
    page = Page(write_report(folder).read_text(encoding="utf-8"))
    widths = {
        values["title"]: float(re.search(r"flex-grow:([\d.]+)", values["style"])[1])
        for tag, values in page.tags
        if tag == "span" and "flex-grow" in values.get("style", "")
    }
    assert widths == {"track": 25, "integrate": 15, "others": 0}
    said = " ".join(page.texts)
    assert "Time per stage: 40.0 ms per frame on average; not part of it: movers 6.0 ms" in said


def test_the_truth_is_drawn_in_the_world_of_the_run(tmp_path):
    """The run's own path in another world, 2 cm off in one frame: both lines coincide and the error has one peak."""
    folder = write_run(tmp_path / "run")
    found = Trajectory.load(folder / "trajectory.txt")
    T = se3.exp(np.array([1.0, 2.0, 3.0, 0.4, 0.5, 0.6]))
    Ts = found.Ts_world_camera.copy()
    Ts[:, 1, 3] = 0.3 * np.sin(np.arange(len(Ts)))  # not on a line
    Trajectory(found.timestamps, Ts).save(folder / "trajectory.txt")
    Trajectory(found.timestamps, T @ Ts).save(folder / "groundtruth.txt")
    run = RunFiles.load(folder)
    assert run.errors.rmse < 1e-6
    drawn = plots(run)
    assert list(drawn)[:2] == ["Trajectory seen from above", "Error over time, after least-squares alignment"]
    above = drawn["Trajectory seen from above"]
    for label in ("true", "estimated", "lost (1 gap)", "start", "end"):
        assert f">{label}</text>" in above
    curves = re.findall(r'<path d="([^"]+)"[^>]*stroke-linecap: square', above)
    true, estimated = (np.array(re.findall(r"[-\d.]+", curve), float).reshape(-1, 2) for curve in curves[:2])
    assert len(true) == FRAMES - 1
    for point in estimated:  # which is interrupted where the frame is lost
        assert np.abs(true - point).sum(axis=1).min() < 0.1


def test_a_truth_of_another_time_is_no_plot(tmp_path):
    folder = write_run(tmp_path / "run", accuracy_missing="no pair")
    found = Trajectory.load(folder / "trajectory.txt")
    Trajectory(found.timestamps + 100, found.Ts_world_camera).save(folder / "groundtruth.txt")
    page = Page(write_report(folder).read_text(encoding="utf-8"))
    assert rows(page)["no accuracy, because"] == "no pair"
    assert "Error over time" not in " ".join(page.texts)


def test_names_of_a_recording_are_no_markup(text):
    assert "<chair>" not in text.replace("\\u003cchair>", "")
    assert "desk &amp; &lt;chair&gt;" in text


def test_the_same_run_gives_the_same_page(tmp_path, text):
    write_report(write_run(tmp_path / "again"), tmp_path / "other.html")
    assert (tmp_path / "other.html").read_text(encoding="utf-8") == text


@pytest.mark.parametrize(
    ("metrics", "sentence"),
    [
        ({"mesh_triangles": 0}, "mesh"),
        ({"complete": False, "stopped_by": "interrupted after 3 frames"}, "Incomplete: interrupted after 3 frames"),
        ({"tracked": 0, "mesh_triangles": 0}, "0 of 12 frames were tracked"),
    ],
)
def test_a_run_without_mesh_or_poses_has_a_page(tmp_path, metrics, sentence):
    page = Page(write_report(write_run(tmp_path / "run", **metrics)).read_text(encoding="utf-8"))
    assert sentence in " ".join(page.texts)
    assert (json.loads(page.by_id["run"])["mesh"] is None) == (metrics.get("mesh_triangles") == 0)


def remove_metrics(folder):
    (folder / "metrics.json").unlink()


def damage_metrics(folder):
    (folder / "metrics.json").write_text("{")


def from_the_future(folder):
    (folder / "metrics.json").write_text('{"versions": {"dudmap": "999.1.0"}}')


def damage_movers(folder):
    (folder / "movers.jsonl").write_text("{}\n")


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (remove_metrics, "is no complete run folder: it has no metrics.json"),
        (damage_metrics, r"metrics.json is damaged"),
        (from_the_future, r"was written by dudmap 999.1.0 and this is .*; update dudmap"),
        (damage_movers, "movers.jsonl"),
    ],
)
def test_folders_that_cannot_be_used(tmp_path, spoil, sentence):
    folder = write_run(tmp_path / "run")
    spoil(folder)
    with pytest.raises(DudmapError, match=sentence):
        write_report(folder)


def test_the_command(tmp_path):
    folder = write_run(tmp_path / "run")
    done = CliRunner().invoke(app, ["report", str(folder), "--out", str(tmp_path / "page.html"), "--json"])
    assert json.loads(done.stdout)["bytes"] == (tmp_path / "page.html").stat().st_size
    done = CliRunner().invoke(app, ["report", str(tmp_path / "nowhere")])
    assert done.exit_code == 1
    assert done.stderr.startswith("dudmap: there is no run folder")
    done = CliRunner().invoke(app, ["report", str(folder), "--out", "/proc/dudmap/page.html"])
    assert "cannot write the report" in done.stderr


def test_a_run_keeps_images_and_writes_its_report(slam, tmp_path, monkeypatch):
    slam.script = {2: "lost"}
    monkeypatch.setattr("sys.argv", ["/usr/bin/dudmap", "run", "my desk", "--token", "secret"])
    out = tmp_path / "out"
    recording = open_sequence(write_recording(tmp_path / "desk", 6))
    for _ in range(2):  # the second run finds the files of the first
        run(recording, Config(), out, progress=False, observers=(ReportObserver(),))
    assert len(list((out / "thumbnails").iterdir())) == 6 * 4
    said = " ".join(Page((out / "report.html").read_text(encoding="utf-8")).texts)
    assert "5 of 6 frames were tracked" in said
    assert "dudmap run 'my desk' --token ..." in said
    finished = datetime.fromisoformat(json.loads((out / "metrics.json").read_text())["date"])
    assert abs((datetime.now().astimezone() - finished).total_seconds()) < 3600
    run(recording, Config(), out, progress=False)
    assert not (out / "report.html").exists()
    assert not list((out / "thumbnails").iterdir())


def test_an_interrupted_run_has_a_report(slam, tmp_path):
    slam.script = {3: KeyboardInterrupt()}
    with pytest.raises(KeyboardInterrupt):
        run(
            open_sequence(write_recording(tmp_path / "desk", 6)), Config(), tmp_path / "out", progress=False,
            observers=(ReportObserver(),),
        )  # fmt: skip
    assert "Incomplete: interrupted after 3 frames" in (tmp_path / "out/report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("count", [1, 20, 36, 37, 500])
def test_kept_frames_are_evenly_spaced(tmp_path, count, known):
    number = count if known else None
    observer = Thumbnails()
    observer.start(None, tmp_path, number)
    read = type("Read", (), {"frame": type("F", (), {"rgb": np.zeros((2, 2, 3), np.uint8), "depth": np.zeros((2, 2))})})
    for index in range(count):
        mask = np.zeros((2, 2), bool)
        observer.frame(index, read, fake_result(float(index), mask=mask), 1.0)
    kept = sorted(float(re.sub(r"\.color\.jpg$", "", p.name)) for p in (tmp_path / "thumbnails").glob("*.color.jpg"))
    if number is None:
        assert min(count, NUMBER) <= len(kept) <= 2 * NUMBER
        assert len(set(np.diff(kept))) <= 1
        return
    assert len(kept) == min(count, NUMBER)
    gaps = np.diff([*kept, count])
    assert gaps.max() - gaps.min() <= 1
