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

import dudmap.kernels

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]

for kernels in pkgutil.iter_modules(dudmap.kernels.__path__):  # compiled from the code as it is
    importlib.import_module(f"dudmap.kernels.{kernels.name}")

with atheris.instrument_imports(include=["dudmap", "rosbags"]):
    import dudmap.calibration.depth_model
    import dudmap.config
    import dudmap.evaluation.files
    import dudmap.exporting.run_content
    import dudmap.geometry.mesh
    import dudmap.mapping.adaptive_volume
    import dudmap.mapping.volume
    import dudmap.places.saved_map
    import dudmap.sequences
    import dudmap.sequences.camera_json
    import dudmap.sequences.masks
    import dudmap.state.database
    import dudmap.state.system
    import dudmap.viewing.run_files

    dudmap.sequences.readers()

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
