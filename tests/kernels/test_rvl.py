"""Compression of depth images, against the text of the format (Wilson 2017) group by group in plain Python."""

import struct

import numpy as np
import pytest

from dudmap.core.backends.cpu.rvl import HEADER, compressed, decompressed


def groups(value: int) -> list[int]:
    """Four-bit groups of a number."""
    digits = [int(digit) for digit in reversed(np.base_repr(value, 8))]
    return [digit + 8 for digit in digits[:-1]] + digits[-1:]


def written(image: np.ndarray) -> bytes:
    """What the format says of an image."""
    found, before, rest = [], 0, image.reshape(-1).tolist()
    while rest:
        zeros = next((n for n, value in enumerate(rest) if value), len(rest))
        others = next((n for n, value in enumerate(rest[zeros:]) if not value), len(rest) - zeros)
        found += groups(zeros) + groups(others)
        for value in rest[zeros : zeros + others]:
            found += groups(2 * (value - before) if value >= before else -2 * (value - before) - 1)
            before = value
        rest = rest[zeros + others :]
    found += [0] * (-len(found) % 8)
    words = ["".join(f"{group:x}" for group in found[n : n + 8]) for n in range(0, len(found), 8)]
    return struct.pack("<II", *image.shape[::-1]) + b"".join(bytes.fromhex(word)[::-1] for word in words)


def images():
    random = np.random.default_rng(3)
    yield np.zeros((5, 7), np.uint16)
    yield np.full((5, 7), 65535, np.uint16)
    yield np.tile(np.array([0, 65535], np.uint16), (6, 9))
    for share in (0.1, 0.5, 0.95):
        yield (random.integers(0, 65536, (24, 31)) * (random.random((24, 31)) < share)).astype(np.uint16)
    yield (1000 + 3 * np.arange(640)[None] + np.arange(48)[:, None]).astype(np.uint16)


@pytest.mark.parametrize("image", images())
def test_images_are_written_as_the_format_says_and_come_back(image):
    assert compressed(image) == written(image)
    np.testing.assert_array_equal(decompressed(written(image)), image)


def test_what_is_no_image_is_recognised():
    random = np.random.default_rng(4)
    data = compressed((1000 + 3 * np.arange(640)[None] + np.arange(48)[:, None]).astype(np.uint16))
    assert all(decompressed(data[:stop]) is None for stop in range(0, len(data) - 4, 97))
    assert decompressed(HEADER.pack(1 << 20, 1 << 20) + b"\xff" * 64) is None
    assert decompressed(HEADER.pack(0, 0)) is None
    for _ in range(300):  # nothing that is read lies outside
        noise = random.integers(0, 256, random.integers(0, 200), np.uint8).tobytes()
        found = decompressed(HEADER.pack(40, 30) + noise)
        assert found is None or found.shape == (30, 40)
