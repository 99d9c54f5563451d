"""Writers of hostile arrays, and how they must be refused."""

import struct
import time
import zipfile

import pytest
from verdict import check_sentence

from dudmap.errors import DudmapError


def refused(call, kind=DudmapError, match=None):
    """``call`` ends at once with one sentence."""
    start = time.monotonic()
    with pytest.raises(kind, match=match) as error:
        call()
    check_sentence(error.value)
    assert time.monotonic() - start < 10


def npz(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return path


def npy(header, body=b""):
    header = header.encode() + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + body
