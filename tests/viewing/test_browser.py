"""Both pages in a real browser: they load without errors, draw something, and react.

Needs the package playwright and a Chromium, on the PATH (on Debian: apt install chromium) or named by DUDMAP_CHROMIUM.
"""

import socket
import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from browsers import SOFTWARE, find_chromium
from dudmap.app.viewing.report import write_report
from dudmap.app.viewing.run_files import RunFiles
from dudmap.app.viewing.snapshot import DEPTH_RANGE, RESIDUAL_RANGE
from dudmap.core.geometry.mesh import Mesh
from dudmap.fleet.change_report import change_page
from run_folders import write_run
from security.hostile_runs import MARKUP, write_hostile_run

playwright = pytest.importorskip("playwright.sync_api", reason="the package playwright is not installed")
CHROMIUM = find_chromium()
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(not CHROMIUM, reason="no Chromium on the PATH, and DUDMAP_CHROMIUM names none"),
]


class Tab:
    """A page with its errors and requests."""

    def __init__(self, browser):
        self.page = browser.new_page(viewport={"width": 720, "height": 560})
        self.errors, self.requests = [], []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", lambda line: self.errors.append(line.text) if line.type == "error" else None)
        self.page.on("request", lambda request: self.requests.append(request.url))

    def picture(self, selector="canvas"):
        png = self.page.locator(selector).first.screenshot()
        return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR).astype(int)


@pytest.fixture(scope="module")
def driver():
    with playwright.sync_playwright() as started:
        yield started


@pytest.fixture(scope="module")
def browser(driver):
    browser = driver.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE)
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("browser") / "run")


@pytest.fixture(scope="module")
def report(browser, folder):
    tab = Tab(browser)
    tab.page.context.set_offline(True)
    tab.page.goto(write_report(folder).as_uri())
    tab.page.wait_for_selector("html[data-ready=true]", timeout=30000)
    return tab


def set_time(tab, number):
    script = "n => { const t = document.getElementById('time'); t.value = n; t.dispatchEvent(new Event('input')); }"
    tab.page.evaluate(script, number)


def test_the_report_loads_offline_without_errors(report):
    assert report.errors == []
    assert [url for url in report.requests if not url.startswith(("file:", "data:", "blob:"))] == []
    assert report.page.text_content("#notice") == ""


def test_a_report_of_a_hostile_run_runs_nothing_but_its_own_script(browser, tmp_path):
    tab = Tab(browser)
    page = write_report(write_hostile_run(tmp_path / "run"))
    tab.page.goto(page.as_uri())
    tab.page.wait_for_selector("html[data-ready=true]", timeout=30000)
    assert tab.errors == []
    assert tab.page.evaluate("window.harmed") is None
    assert "<img src=x onerror" in tab.page.text_content("ul.cards ~ *, section h2 ~ ul")
    # even markup that got through would run nothing
    page.write_text(page.read_text(encoding="utf-8").replace("<header>", f"<header>{MARKUP}"), encoding="utf-8")
    tab.page.goto(page.as_uri())
    tab.page.wait_for_selector("html[data-ready=true]", timeout=30000)
    assert tab.page.evaluate("window.harmed") is None
    assert sum("Content Security Policy" in error for error in tab.errors) >= 2


def test_the_first_view_of_the_report_holds_the_whole_map_and_trajectory(report):
    places = """() => {
      const { mesh, poses, camera } = window.dudmapView, corners = mesh.geometry.getAttribute("position");
      const points = poses.map((pose) => new THREE.Vector3().setFromMatrixPosition(pose));
      for (let i = 0; i < corners.count; i++) points.push(new THREE.Vector3().fromBufferAttribute(corners, i));
      return points.map((point) => point.project(camera).toArray());
    }"""
    seen = np.abs(report.page.evaluate(places))
    assert seen.max() <= 1.0  # inside of the picture, in front of the camera
    assert seen[:, :2].max() > 0.9  # and no farther away than that takes


def test_the_images_of_a_frame_have_captions(report):
    set_time(report, 0)
    captions = report.page.locator("#now figcaption").all_text_contents()
    reach = f"{100 * RESIDUAL_RANGE:.0f} cm"
    assert captions == [
        "colour; 0.00 s", "what moves, red; 0.00 s", f"depth, blue 0 to red {DEPTH_RANGE:.0f} m; 0.00 s",
        f"residuals, blue -{reach} to red {reach}, dark off the map; 0.00 s",
    ]  # fmt: skip


def test_the_report_draws_the_map(report):
    before = report.picture("#canvas")
    assert before.std() > 10
    report.page.uncheck("#show-mesh")
    assert np.abs(report.picture("#canvas") - before).mean() > 5
    report.page.check("#show-mesh")
    report.page.check("#shape")
    assert np.abs(report.picture("#canvas") - before).mean() > 5
    report.page.uncheck("#shape")


def test_the_slider_of_the_report_moves_the_camera(report):
    set_time(report, 0)
    before = report.picture("#canvas")
    set_time(report, 10)  # the eleventh tracked frame: frame 11, at x = 0.55 m
    at = "Array.from(window.dudmapView.body.matrix.elements).slice(12, 15)"
    np.testing.assert_allclose(report.page.evaluate(at), [0.55, 0, 0], atol=1e-6)
    assert np.abs(report.picture("#canvas") - before).max() > 50
    report.page.check("#ride")
    np.testing.assert_allclose(report.page.evaluate("window.dudmapView.camera.position.toArray()"), [0.55, 0, 0])
    report.page.uncheck("#ride")


def test_the_report_shows_what_moves_at_its_time(report):
    set_time(report, 4)
    assert "object 4: 0.50 m/s" in report.page.text_content("#clock")
    assert report.page.evaluate("window.dudmapView.movers.children.length") == 1
    set_time(report, 0)
    assert report.page.evaluate("window.dudmapView.movers.children.length") == 0
    assert report.page.locator("#now img").count() == 4


def test_a_click_on_the_map_gives_a_point_and_two_a_distance(report):
    report.page.check("#ride")
    box = report.page.locator("#canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    report.page.mouse.click(x, y)
    assert report.page.text_content("#point") == "x 0.000, y 0.000, z 2.000 m"
    report.page.mouse.click(x + 60, y)
    assert "m from the point before" in report.page.text_content("#point")
    report.page.uncheck("#ride")


def test_a_browser_without_webgl_is_told_so_and_sees_the_rest(driver, folder):
    browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-3d-apis"])
    page = browser.new_page()
    page.goto(write_report(folder).as_uri())
    page.wait_for_selector("html[data-ready=true]", timeout=30000)
    assert "no WebGL" in page.text_content("#notice")
    assert page.locator("#now img").count() == 4
    browser.close()


@pytest.fixture(scope="module")
def window(folder):
    pytest.importorskip("viser", reason="the extra view is not installed")
    from dudmap.app.viewing.live_view import show_run
    from dudmap.app.viewing.window import Window

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    window = Window("127.0.0.1", port, "test")
    show_run(window, RunFiles.load(folder))
    yield window
    window.stop()


@pytest.fixture(scope="module")
def live(browser, window):
    tab = Tab(browser)
    tab.page.goto(window.url)
    tab.page.wait_for_selector("text=follow the run", timeout=30000)
    until(lambda: tab.picture().std() > 5)
    return tab


def until(condition, seconds=20):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.2)


def test_the_window_draws_the_map_without_errors(live):
    # a picture that is replaced before the browser has decoded it is reported as a missing blob
    assert [error for error in live.errors if "ERR_FILE_NOT_FOUND" not in error] == []
    assert all("127.0.0.1" in url or "localhost" in url or url.startswith(("data:", "blob:")) for url in live.requests)


def test_the_slider_of_the_window_moves_the_camera(live, window):
    thumb = live.page.locator("[role=slider]").first
    thumb.focus()
    for _ in range(5):
        thumb.press("ArrowRight")
    until(lambda: window._shown == 5 and "/movers/4/box" in window._handles)
    np.testing.assert_allclose(window._handles["/camera"].position, [0.25, 0, 0], atol=1e-6)


LAYERS = ["map", "trajectory", "camera", "labels", "moving objects", "keyframes"]


@pytest.mark.parametrize("layer", LAYERS)
def test_every_layer_of_a_finished_run_can_be_switched(live, window, layer):
    window.show_frame(5)  # something moves
    switch = live.page.get_by_label(layer, exact=True)
    for turn in (switch.uncheck, switch.check):
        until(lambda: np.array_equal(live.picture(), live.picture()))  # parts fade in
        before = live.picture()
        turn(force=True)
        until(lambda before=before: np.abs(live.picture() - before).max() > 20)


def test_two_clicks_measure_a_distance_on_the_map(live, window):
    """The wall is the plane z = 2; the rays of the pixels come from the page's camera alone."""
    canvas = live.page.locator("canvas[data-engine]")
    box = canvas.bounding_box()
    (client,) = window._server.get_clients().values()
    at, ahead = np.array(client.camera.position), np.array(client.camera.look_at)
    z = (ahead - at) / np.linalg.norm(ahead - at)
    x = np.cross(z, [0, -1, 0]) / np.linalg.norm(np.cross(z, [0, -1, 0]))
    points = []
    for u, v in ((0.45, 0.5), (0.55, 0.56)):
        canvas.click(position={"x": u * box["width"], "y": v * box["height"]})
        up = 2 * np.tan(client.camera.fov / 2) / box["height"]
        ray = z + (u - 0.5) * box["width"] * up * x + (v - 0.5) * box["height"] * up * np.cross(z, x)
        points.append(at + (2 - at[2]) / ray[2] * ray)
        until(lambda: window._point.content.startswith("x ") and len(window._marks) == len(points))
    measured = float(window._point.content.split("**")[1].split(" m")[0])
    assert measured == pytest.approx(np.linalg.norm(points[1] - points[0]), abs=0.01)
    live.page.wait_for_selector(f"text={measured:.3f} m", timeout=20000)


def test_a_live_window_grows(browser, window):
    """New frames appear on an open page without a reload."""
    from dudmap.app.viewing.snapshot import FrameFigures

    window._follow.value = True
    T = np.eye(4)
    T[0, 3] = 1.5
    window.add_frames([FrameFigures(110.0, T, "", (), 33.0, 0.002, 0.5)])
    assert window._shown == 12
    assert window._slider.max == 12
    assert window._state.content.endswith("50% of the readings move")


def test_the_window_tells_a_browser_without_webgl(driver, window):
    browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-3d-apis"])
    page = browser.new_page()
    page.goto(window.url)
    page.wait_for_selector("text=WebGL is unavailable", timeout=30000)
    browser.close()


def test_the_page_on_changes_flies_to_a_change(browser, tmp_path):
    corners = np.random.default_rng(1).uniform(0, 1, (60, 3)).astype(np.float32)
    faces, colors = np.arange(60, dtype=np.int32).reshape(-1, 3), np.full((60, 3), 90, np.uint8)
    mesh = Mesh(corners, faces, colors, np.tile(np.float32([0, 0, 1]), (60, 1)))
    visit = SimpleNamespace(keyframes=np.eye(4)[None], mesh=mesh)
    row = {"id": 1, "kind": "appeared", "box": [[0.1, 0.1, 0.1], [0.3, 0.3, 0.3]], "confidence": 0.9}
    tree = {"before": "a", "after": "b", "notes": [], "counts": {"appeared": 1}, "changes": [row]}
    (tmp_path / "page.html").write_text(change_page(tree, [mesh, mesh], [visit, visit], [None]))
    tab = Tab(browser)
    tab.page.goto((tmp_path / "page.html").as_uri())
    tab.page.wait_for_selector("html[data-ready=true]", timeout=30000)
    assert (tab.errors, tab.page.text_content("#notice")) == ([], "")
    far = tab.picture()
    tab.page.click("#changes li")
    assert np.abs(tab.picture() - far).max() > 50
