"""Every optional library: imported in one way, and missed with one sentence that names its extra."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from typer.testing import CliRunner

import dudmap
from bags import write_bag
from dudmap.cli import app
from dudmap.core.backends.device import _resolved
from dudmap.errors import MissingExtraError
from dudmap.extras import STUDY, extra, need
from exported_runs import make_run
from recordings import write_recording
from run_folders import write_run

ROOT = Path(__file__).parents[1]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
USED = {name for name in EXTRAS if name not in ("all", "dev", "docs")}


@pytest.fixture(scope="module")
def where(tmp_path_factory):
    """A run folder, the same in the exporters' sense, a recording, a bag, a .r3d file and a design."""
    import zipfile

    folder = tmp_path_factory.mktemp("extras")
    write_run(folder / "seen")
    make_run(folder, frames=2, movers=())
    write_recording(folder / "desk", 3)
    write_bag(folder / "walk.bag", "ros1")
    with zipfile.ZipFile(folder / "scan.r3d", "w") as archive:
        archive.writestr("metadata", "{}")
        archive.writestr("rgbd/0.depth", "")
    (folder / "walk.mkv").write_bytes(b"\x1aE\xdf\xa3")
    (folder / "design.toml").write_text("")
    return folder


CASES = [
    ("view", "viser", ["view", "seen"]),
    ("view", "viser", ["run", "desk", "--view"]),
    ("rerun", "rerun", ["run", "desk", "--rerun", "a.rrd"]),
    ("ros-bags", "rosbags.typesys", ["info", "walk.bag"]),
    ("ros-bags", "rosbags.typesys", ["run", "walk.bag"]),
    ("ros-bags", "rosbags.rosbag2", ["export", "run", "--out", "a.mcap"]),
    ("ros-bags", "rosbags.rosbag2", ["live", "replay:desk", "--record", "a.mcap"]),
    ("record3d", "lzfse", ["info", "scan.r3d"]),
    ("azure-kinect", "av", ["info", "walk.mkv"]),
    ("realsense", "pyrealsense2", ["live", "realsense"]),
    ("oak", "depthai", ["live", "oak"]),
    ("orbbec", "pyorbbecsdk", ["live", "orbbec"]),
    ("iphone", "record3d", ["live", "iphone"]),
    ("export", "laspy", ["export", "run", "--out", "a.laz"]),
    ("export", "lazrs", ["export", "run", "--out", "a.laz"]),
    ("export", "pye57", ["export", "run", "--out", "a.e57"]),
    ("export", "pxr.Sdf", ["export", "run", "--out", "a.usdz"]),
    ("export", "fast_simplification", ["export", "run", "--out", "a.ply", "--max-triangles", "4"]),
    ("texture", "xatlas", ["export", "run", "--out", "a.glb", "--texture", "--sequence", "recording"]),
    *(("study", module, ["study", "design.toml"]) for module in STUDY),
    ("study", "optuna", ["study", "tune", "design.toml"]),
    ("study", "pandas", ["study", "thesis", "--published"]),
    ("gpu", "warp", ["run", "desk", "--device", "warp-cpu"]),
]


@pytest.mark.parametrize(("name", "module", "arguments"), CASES, ids=lambda value: str(value))
def test_a_missing_library_is_one_sentence_that_names_its_extra(slam, where, monkeypatch, name, module, arguments):
    monkeypatch.chdir(where)
    monkeypatch.setitem(sys.modules, module, None)
    _resolved.cache_clear()
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 1, done.output
    last = done.stderr.strip().splitlines()[-1]
    top = module.partition(".")[0]
    assert re.fullmatch(
        rf'dudmap: .+ needs the extra {name} \({top} is not installed\); pip install "\.\[{name}\]" in the folder .+',
        last,
    )
    assert not list(where.glob("a.*"))


def test_every_extra_is_tried_here_and_is_part_of_all():
    assert {name for name, _, _ in CASES} == USED
    everything = set(re.findall(r"[\w-]+", EXTRAS["all"][0].partition("[")[2]))
    assert everything == USED


def test_a_library_that_cannot_be_loaded_is_told_apart():
    with pytest.raises(MissingExtraError, match=r"installed but cannot be loaded \(libusb: no such file\)"):
        with extra("oak", "a camera"):
            raise ImportError("libusb: no such file")
    need("study", "this", ("json",))


# -- the source --------------------------------------------------------------------------------------------------------

REQUIRED = {
    "numpy",
    "numba",
    "llvmlite",
    "cv2",
    "pydantic",
    "pydantic_core",
    "markdown_it",
    "scipy",
    "matplotlib",
    "trimesh",
    "rich",
    "typer",
    "tomli_w",
    "click",
    "PIL",
    "yaml",
}


def optional_imports(tree):
    """Name and line of every import of an optional library outside of ``with extra(...)`` and ``if TYPE_CHECKING``."""

    def walk(node):
        if isinstance(node, ast.With) and any("extra(" in ast.unparse(item.context_expr) for item in node.items):
            return
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            return
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names = [node.module or ""]
        for name in names:
            top = name.partition(".")[0]
            if top not in sys.stdlib_module_names and top not in REQUIRED and top != "dudmap":
                yield top, node.lineno
        for child in ast.iter_child_nodes(node):
            yield from walk(child)

    return list(walk(tree))


def test_optional_libraries_are_imported_in_one_way_only():
    """Inside of ``with extra(...)``, or behind it: a study asks for all of its extra at once, rosbags
    is asked for when a bag is opened, and Warp when a device is chosen."""
    behind = {
        "core/backends": {"warp"},
        "lab/benchmark": {"warp"},
        "lab/study": set(STUDY),
        "io/sequences": {"rosbags", "lz4"},
        "io/cameras": {"rosbags"},
    }
    root = Path(dudmap.__file__).parent
    for path in root.rglob("*.py"):
        package = "/".join(path.relative_to(root).parts[:2])
        if path.name == "open3d_slam.py":  # a script that another interpreter runs
            continue
        found = optional_imports(ast.parse(path.read_text(encoding="utf-8")))
        assert [(top, line) for top, line in found if top not in behind.get(package, set())] == [], path


def test_every_required_library_is_a_dependency():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    names = {re.split(r"[<>=\[ ]", text)[0].lower() for text in project["dependencies"]}
    homes = packages_distributions()
    parts = {"llvmlite", "pydantic_core", "click", "PIL"}  # of numba, pydantic, typer and matplotlib
    for module in REQUIRED - parts:
        assert names & {home.lower().replace("_", "-") for home in homes[module]}, module
