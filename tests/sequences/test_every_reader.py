"""No reader is without a test."""

from pathlib import Path

from dudmap.io.sequences import reader_of, readers
from layouts import LAYOUTS, write


def test_every_reader_reads_a_folder_of_an_independent_writer_or_has_a_test_of_its_file(tmp_path):
    folders = {reader_of(write(layout, tmp_path / layout.__name__)[0]) for layout in LAYOUTS}
    tests = "".join(path.read_text(encoding="utf-8") for path in Path(__file__).parent.glob("*.py"))
    assert [kind for kind in readers() if kind not in folders and f'"{kind.format}"' not in tests] == []
