"""``make fuzz-guided``: inputs that atheris (libFuzzer) grows towards unvisited branches of one loader.

Usage: python tests/fuzz/guided.py "sens" [libFuzzer's options, e.g. -max_total_time=60]

For loaders of one file. Needs the package atheris, which nothing else needs: pip install atheris. An input that fails
is written to the folder of the call as ``crash-...``; the corpus lives in a temporary folder and starts with the valid
file.
"""

import importlib
import pkgutil
import shutil
import sys
import tempfile
import warnings
from pathlib import Path

import atheris

import dudmap.core.backends.cpu

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]

for kernels in pkgutil.iter_modules(dudmap.core.backends.cpu.__path__):  # compiled from the code as it is
    importlib.import_module(f"dudmap.core.backends.cpu.{kernels.name}")

with atheris.instrument_imports(include=["dudmap", "rosbags"]):
    import dudmap.app.state.database
    import dudmap.app.state.system
    import dudmap.app.viewing.run_files
    import dudmap.config
    import dudmap.core.geometry.mesh
    import dudmap.core.map.adaptive_volume
    import dudmap.core.map.volume
    import dudmap.core.places.saved_map
    import dudmap.evaluation.files
    import dudmap.io.exporting.run_content
    import dudmap.io.sequences
    import dudmap.io.sequences.camera_files
    import dudmap.io.sequences.images

    dudmap.io.sequences.readers()

from trial import Subject


def main() -> None:
    name, options = sys.argv[1], sys.argv[2:]
    folder = Path(tempfile.mkdtemp(prefix="fuzz-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    warnings.simplefilter("ignore")
    subject = Subject(name, folder / "subject")
    subject.warm_up()
    assert list(subject.files) == [subject.path], "a loader of one file"
    corpus = folder / "corpus"
    corpus.mkdir()
    shutil.copy(subject.path, corpus / "valid")

    def read(data: bytes) -> None:
        subject.path.write_bytes(data)
        subject.read()

    largest = max(4 * len(subject.files[subject.path]), 4096)
    atheris.Setup([sys.argv[0], f"-max_len={largest}", "-rss_limit_mb=4096", *options, str(corpus)], read)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
