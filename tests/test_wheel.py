"""The wheel for Linux: whoever installs it compiles nothing, up to mesh and report.

The wheel is unpacked into an empty environment, which is read-only, like the home folder; its dependencies are those of
the tests. Root may write everywhere, so that its processes give up that right (setpriv) first. Building takes minutes;
DUDMAP_WHEEL names a wheel that is already built ("make package").
"""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

import dudmap
from dudmap.core import shipped_kernels
from dudmap.lab.wheel_kernels import SHIPPED

ROOT = Path(__file__).parent.parent
OBEYS = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] if os.geteuid() == 0 else []
PROGRAM = """
import json, sys
from dudmap import Config, run, synthetic
from dudmap.app.viewing.report import write_report
from dudmap.core import kernel_cache, shipped_kernels
from dudmap.core.geometry.camera import Camera
from dudmap.lab.synthetic.faults import SensorFaults

camera = Camera(262.0, 262.0, 159.5, 119.5, 320, 240)
faults = SensorFaults(color_delay=0.02, color_distortion=(0.1, -0.1, 0.0, 0.0))
recording = synthetic.sequence(frames=130, camera=camera, camera_path="handheld", faults=faults)
run(recording, Config(), sys.argv[1], calibrate=True, progress=False)
write_report(sys.argv[1])
print(json.dumps([shipped_kernels.__file__, shipped_kernels.folder().name, kernel_cache.counts]))
"""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="the wheel with kernels is for Linux"),
    pytest.mark.skipif(
        not shipped_kernels.LEVELS["x86-64-v3"] <= shipped_kernels.available(), reason="the processor has no AVX2"
    ),
]


def written():
    """Names of all functions of the package that are kernels by their decorator."""
    found = set()
    for path in Path(dudmap.__file__).parent.rglob("*.py"):
        module = ".".join(path.relative_to(Path(dudmap.__file__).parents[1]).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            decorators = [ast.unparse(one) for one in getattr(node, "decorator_list", [])]
            if any(re.fullmatch(r"kernel|exact|compiled\((?!inline).*\)", one) for one in decorators):
                found.add(f"{module}.{node.name}")
    return found


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    if given := os.environ.get("DUDMAP_WHEEL"):
        return Path(given)
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run([sys.executable, "-m", "dudmap.lab.wheel_kernels", folder / "kernels"], check=True)
    command = [sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", folder, ROOT]
    environment = os.environ | {"DUDMAP_KERNELS": str(folder / "kernels")}
    subprocess.run(command, env=environment, check=True, capture_output=True)
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """Runs the Python of an environment that holds the wheel, with nothing to write to but one folder."""
    place = tmp_path_factory.mktemp("installed")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", place / "clean"], check=True)
    (site,) = (place / "clean").glob("lib/python*/site-packages")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))  # whose own .pth files have no effect
    (place / "home").mkdir()
    folders = [place / "home", *(path for path in place.rglob("*") if path.is_dir() and not path.is_symlink())]
    for folder in folders:
        folder.chmod(0o555)
    kept = {name: value for name, value in os.environ.items() if name in ("PATH", "LANG")}

    def call(tmp_path, *arguments):
        environment = kept | {"HOME": str(place / "home"), "TMPDIR": str(tmp_path)}
        command = [*OBEYS, place / "clean" / "bin" / "python", *map(str, arguments)]
        return subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)

    call.site = site
    yield call
    for folder in folders:
        folder.chmod(0o755)
    shutil.rmtree(place)


def test_the_wheel_is_small_and_holds_the_same_kernels_for_each_level(wheel):
    assert wheel.stat().st_size < 12e6
    with zipfile.ZipFile(wheel) as archive:
        names = [Path(name) for name in archive.namelist() if name.endswith(".nbc")]
    by_level = [{path.name for path in names if path.parent.name == level} for level in SHIPPED]
    assert by_level[0] == by_level[1]
    assert {name.partition("-")[0] for name in by_level[0]} >= written()
    assert {path.parent.parent.name for path in names} == {shipped_kernels.VERSIONS}


def test_nothing_is_compiled_up_to_mesh_and_report(installed, tmp_path):
    done = installed(tmp_path, "-c", PROGRAM, tmp_path / "run")
    assert done.returncode == 0, done.stderr
    module, level, counts = json.loads(done.stdout.splitlines()[-1])
    assert Path(module).is_relative_to(installed.site)
    assert level in SHIPPED
    assert counts.pop("shipped") > 40
    assert counts == {}
    assert not list(tmp_path.rglob("*.nb?"))  # nor by another process of the run
    assert {path.name for path in (tmp_path / "run").iterdir()} >= {"mesh.ply", "report.html"}
    assert "KernelCacheWarning" not in done.stderr


def test_the_installation_tells_which_kernels_it_uses(installed, tmp_path):
    done = installed(tmp_path, "-m", "dudmap", "doctor", "--json")
    (found,) = (check for check in json.loads(done.stdout)["checks"] if check["name"] == "kernels")
    assert found["found"].endswith(("x86-64-v3", "x86-64-v4"))
    assert not done.stderr
