"""Lossless compression of depth by run lengths and differences (RVL; Wilson 2017).

Runs: number of zeros, number of others, and these as differences to the previous. Numbers are groups of three bits,
lowest first, with a continuation bit; eight groups make a 32-bit word, highest first.
"""

import struct

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.threads import kernel, scalar

HEADER = struct.Struct("<II")
"""Columns and rows before the words, as ROS' compressed_depth_image_transport."""
MOST_PIXELS = 1 << 26
"""Largest number of pixels: a few bytes encode many zeros."""


@scalar
def _put(value, words, place):
    while True:
        group = value & 7
        value >>= 3
        group |= 8 if value else 0
        words[place >> 3] |= np.uint32(group) << np.uint32(28 - 4 * (place & 7))
        place += 1
        if value == 0:
            return place


@scalar
def _get(words, place, last):
    value, shift = np.int64(0), 0
    while place < last:
        group = np.int64((words[place >> 3] >> np.uint32(28 - 4 * (place & 7))) & np.uint32(15))
        value |= (group & 7) << shift
        place, shift = place + 1, min(shift + 3, 60)
        if group < 8:
            return value, place
    return value, last + 1


@kernel
def encode(image, words):
    """Compress (n,) uint16 into words (n + 1,) uint32 of 0; returns the used words."""
    n, place, before, number = image.size, 0, np.int64(0), 0
    while number < n:
        start = number
        while number < n and image[number] == 0:
            number += 1
        place, start = _put(number - start, words, place), number
        while number < n and image[number] != 0:
            number += 1
        place = _put(number - start, words, place)
        for k in range(start, number):
            value = np.int64(image[k])
            difference = value - before
            place, before = _put((difference << 1) ^ (difference >> 63), words, place), value
    return (place + 7) >> 3


@kernel
def decode(words, image):
    """Restore (n,) uint16 from uint32 words; returns whether valid."""
    n, place, last, before, number = image.size, 0, 8 * words.size, np.int64(0), 0
    while number < n:
        zeros, place = _get(words, place, last)
        others, place = _get(words, place, last)
        if place > last or zeros + others > n - number or zeros + others == 0:
            return False
        for k in range(number, number + zeros):
            image[k] = 0
        for k in range(number + zeros, number + zeros + others):
            value, place = _get(words, place, last)
            before += (value >> 1) ^ -(value & 1)
            image[k] = np.uint16(before)
        if place > last:
            return False
        number += zeros + others
    return True


def compressed(image: NDArray[np.uint16]) -> bytes:
    """Compressed image (h, w) with its size."""
    words = np.zeros(image.size + 1, np.uint32)
    count = encode(image.reshape(-1), words)
    return HEADER.pack(*image.shape[::-1]) + words[:count].astype("<u4").tobytes()


def decompressed(data: bytes) -> NDArray[np.uint16] | None:
    """The image (h, w) of compressed data; None if invalid."""
    if len(data) < HEADER.size:
        return None
    columns, rows = HEADER.unpack_from(data)
    words = np.frombuffer(data, "<u4", (len(data) - HEADER.size) // 4, HEADER.size).astype(np.uint32)
    if not 0 < columns * rows <= MOST_PIXELS:
        return None
    image = np.empty((rows, columns), np.uint16)
    return image if decode(words, image.reshape(-1)) else None
