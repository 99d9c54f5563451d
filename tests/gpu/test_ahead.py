"""Every kernel compiles for GPUs, without a GPU or a driver."""

import re
from importlib import import_module

import pytest

from dudmap.core.backends.device import make_backend

wp = pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")
make_backend("warp-cpu")

MODULES = [f"dudmap.core.backends.warp.kernels.{name}" for name in ("fusion", "surface", "rows")]
DOUBLE = {"images", "surface"}
"""Modules with sums in float64, or intensities."""


def compiled(folder, modules, architectures, *, ptx=True):
    """The files with the kernels of modules, one per module and architecture."""
    for name in modules:
        import_module(name)
        wp.compile_aot_module(name, arch=architectures, module_dir=str(folder), use_ptx=ptx)
    return sorted(folder.rglob("*.ptx" if ptx else "*.cubin"))


@pytest.fixture(scope="module")
def listings(tmp_path_factory):
    return {path.name: path.read_text() for path in compiled(tmp_path_factory.mktemp("ptx"), MODULES, [90])}


@pytest.mark.parametrize("module", MODULES)
def test_every_kernel_is_in_the_ptx(listings, module):
    kernels = [value for value in vars(import_module(module)).values() if isinstance(value, wp.Kernel)]
    own = [kernel for kernel in kernels if kernel.module.name == module]
    text = next(text for name, text in listings.items() if f"{module}_" in name and "sm90." in name)
    assert ".target sm_90" in text
    assert own
    entries = re.findall(r"\.entry (\w+)", text)
    for kernel in own:
        assert any(kernel.key in entry for entry in entries), kernel.key
    if module.rpartition(".")[2] not in DOUBLE:  # a literal that is no float32 would make the arithmetic float64
        assert ".f64" not in text[text.index(".entry") :]


def test_one_module_becomes_machine_code(tmp_path):
    (file,) = compiled(tmp_path, MODULES[-1:], [90], ptx=False)
    assert file.read_bytes()[:4] == b"\x7fELF"
