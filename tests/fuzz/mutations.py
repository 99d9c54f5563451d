"""Hostile variants of the files of a small valid input, made from a number so that each can be made again."""

import bz2
import io
import lzma
import os
import re
import struct
import tarfile
import zipfile
import zlib
from functools import cache, lru_cache

from state_mutations import state_tree

NUMBERS = (
    b"0", b"-1", b"1e999", b"-1e308", b"nan", b"inf", b"1e-320", b"1000000000", b"999999999999999999999",
    b"9" * 400, b"", b"0x10", b"1_000", b"1.2.3", b"\xd9\xa3", b"4294967296", b"2147483647", b"true", b'"a"', b"[]",
)  # fmt: skip
WORDS = (
    b"\0", b"\n", b"\r", b"\xff\xfe", b"\xed\xa0\x80", b"../" * 20 + b"etc/passwd", b"/dev/zero", b"/dev/stdin",
    b"\x1b[2J", b"#", b",", b"\\", b'"', b"{", b"}", b"[" * 5000, b"{" * 5000, b'{"a":' * 5000, b"a" * 300, b"=",
    b"[a]\n" * 50, b"\xe2\x80\xa8", b'"\\ud800"', b"!!python/object/apply:os.system ['touch /tmp/x']\n", b"%s%n",
)  # fmt: skip
SIZES = (
    0,
    1,
    15,
    16,
    0x7F,
    0x80,
    0xFF,
    0x7FFF,
    0x8000,
    0xFFFF,
    10**9,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**63 - 1,
    2**64 - 1,
)
TEXT = (".txt", ".json", ".toml", ".yaml", ".log", ".freiburg", ".csv", ".jsonl", ".depth", "metadata")
SPECIAL = ("fifo", "zero", "loop", "folder", "missing", "empty", "dangling", "secret")
"""What stands in the place of a file: a pipe nobody writes to, /dev/zero, a link to itself, a folder, nothing."""


def mutated(rng, name, data):
    """Variant of the content of a file with this name."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = rng.choice(mutators(name, data))(rng, data)
    return data


def mutators(name, data):
    if data.startswith(b"\x89PNG"):
        return [png_chunk, png_chunk, png_size, png_bomb, *RAW]
    if data.startswith(b"SQLite format 3"):
        return [state_tree, state_tree, state_tree, state_tree, *RAW]
    if data.startswith(b"PK"):
        return [zip_member, zip_member, zip_member, zip_bomb, zip_names, *RAW]
    if data.startswith(b"\x93NUMPY"):
        return [npy_header, npy_header, *RAW]
    if name.endswith((".tar", ".tgz", ".gz", ".bz2", ".xz")):
        return [tar_member, *RAW]
    if name.endswith(TEXT) or not any(byte > 127 for byte in data[:200]):
        return [*LINES, *LINES, *RAW]
    return RAW


# -- bytes -------------------------------------------------------------------------------------------------------------


def truncate(rng, data):
    return data[: rng.randrange(len(data) + 1)]


def flip(rng, data):
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 3, 20))):
        if out:
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def set_size(rng, data):
    """A number of 1 to 8 bytes with an extreme value; the first bytes, where headers are, more often."""
    width, order = rng.choice((1, 2, 4, 8)), rng.choice(("little", "big"))
    if len(data) < width:
        return data
    at = rng.randrange(min(len(data) - width + 1, rng.choice((16, 64, 400, len(data)))) or 1)
    value = (rng.choice(SIZES) & (2 ** (8 * width) - 1)).to_bytes(width, order)
    return data[:at] + value + data[at + width :]


def remove(rng, data):
    start = rng.randrange(len(data) + 1)
    return data[:start] + data[start + rng.choice((1, 4, 40)) :]


def insert(rng, data):
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice((b"\0" * 8, b"\xff" * 8, rng.randbytes(4), *WORDS)) + data[at:]


def splice(rng, data):
    a, b = rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)
    return data[:a] + data[b:]


def floats(rng, data):
    """An extreme float in the place of four or eight bytes."""
    value = rng.choice((float("nan"), float("inf"), -float("inf"), 0.0, -1.0, 3e38, 1e-45))
    packed = struct.pack(rng.choice(("<f", "<d")), value)
    at = rng.randrange(max(len(data) - len(packed), 0) + 1)
    return data[:at] + packed + data[at + len(packed) :]


RAW = [truncate, flip, flip, set_size, set_size, remove, insert, splice, floats]

# -- text --------------------------------------------------------------------------------------------------------------


def number(rng, data):
    found = list(re.finditer(rb"-?\d+\.?\d*(?:e[-+]?\d+)?", data[:20000]))
    if not found:
        return data
    place = rng.choice(found)
    return data[: place.start()] + rng.choice(NUMBERS) + data[place.end() :]


def word(rng, data):
    found = list(re.finditer(rb"[^\s,]+", data[:20000]))
    if not found:
        return data
    place = rng.choice(found)
    return data[: place.start()] + rng.choice(WORDS) + data[place.end() :]


def line(rng, data):
    lines = data.splitlines(keepends=True) or [b""]
    k = rng.randrange(len(lines))
    change = rng.randrange(4)
    if change == 0:
        del lines[k]
    elif change == 1:
        lines.insert(k, lines[rng.randrange(len(lines))])
    elif change == 2:
        lines[k] = lines[k].rstrip(b"\n")
    elif len(data) < 2**20:  # not again and again in one input
        lines += [lines[k]] * 500
    return b"".join(lines)


def key(rng, data):
    """Another name or value of a key, as in JSON and TOML."""
    found = list(re.finditer(rb'"?\w+"?\s*[:=]', data[:20000]))
    if not found:
        return data
    place = rng.choice(found)
    return (
        data[: place.start()]
        + rng.choice((b'"x":', b"x =", b"", place[0] + b" [1] ", place[0] * 2))
        + data[place.end() :]
    )


LINES = [number, number, number, word, line, key]

# -- containers, with right checksums ----------------------------------------------------------------------------------


def png_parts(data):
    at, parts = 8, []
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        parts.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    return parts


def png(parts):
    chunks = (
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in parts
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def png_chunk(rng, data):
    parts = png_parts(data)
    if not parts:
        return data
    k = rng.randrange(len(parts))
    kind, body = parts[k]
    change = rng.randrange(4)
    if change == 0:
        parts[k] = kind, rng.choice(RAW)(rng, body)
    elif change == 1:
        parts[k] = rng.choice((b"tRNS", b"PLTE", b"iCCP", b"acTL", b"fcTL", b"fdAT", b"eXIf", b"tEXt")), body
    elif change == 2:
        parts.insert(k, (rng.choice((b"acTL", b"fcTL", b"zTXt", b"iCCP", kind)), rng.randbytes(26)))
    else:
        del parts[k]
    return png(parts)


def png_size(rng, data):
    parts = png_parts(data)
    if not parts or len(parts[0][1]) != 13:
        return data
    header = bytearray(parts[0][1])
    struct.pack_into(">II", header, 0, rng.choice((1, 64, 2**16, 2**20, 2**31)), rng.choice((1, 48, 2**16, 2**20)))
    header[8:] = bytes((rng.choice((1, 2, 8, 16, 77)), rng.choice((0, 2, 3, 4, 6)), 0, 0, rng.randrange(2)))
    return png([(parts[0][0], bytes(header)), *parts[1:]])


def png_bomb(rng, data):
    side = rng.choice((5000, 30000, 60000))
    header = struct.pack(">II", side, side) + bytes((8, 0, 0, 0, 0))
    return png([(b"IHDR", header), (b"IDAT", packed_zeros()), (b"IEND", b"")])


@cache
def packed_zeros():
    return zlib.compress(bytes(2**20))


def npy_header(rng, data):
    """Another header of an array: dimensions, type, objects, code."""
    headers = (
        "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000, 1000), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 3), }",
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
        "{'descr': [('a', '|O')], 'fortran_order': False, 'shape': (), }",
        "{'descr': '<U999999999', 'fortran_order': False, 'shape': (), }",
        "{'descr': '|V0', 'fortran_order': False, 'shape': (1000000000000,), }",
        "{'descr': '<U0', 'fortran_order': True, 'shape': (1000000000000,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (0, 1000000000000000000), }",
        "__import__('os').system('touch fuzz-was-here')",
        "(" * 500 + ")" * 500,
        "{'descr': '<f4', 'fortran_order': 7, 'shape': [1], }",
        "{'descr': '>c16', 'fortran_order': True, 'shape': (1, 1, 1, 1, 1, 1, 1, 1, 1, 1), }",
    )
    if rng.random() < 0.4:
        return rng.choice((number, word, flip, set_size))(rng, data[:128]) + data[128:]
    header = rng.choice(headers).encode() + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + data[128:]


@lru_cache(maxsize=4)
def zip_parts(data):
    """Names and contents of the members of an archive."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return tuple((name, archive.read(name)) for name in archive.namelist())
    except Exception:  # a variant that is no archive any more is changed as bytes only
        return ()


def zipped(parts):
    """Archive of members; unlike the standard library's it packs what was packed before only once."""
    out, index = b"", b""
    for name, body in parts:
        packed, check = deflated(body)
        raw = name.encode("utf-8", "surrogateescape")
        size = struct.pack("<5H3I2H", 20, 1 << 11, 8, 0, 33, check, len(packed), len(body), len(raw), 0)
        index += struct.pack("<4sH", b"PK\1\2", 20) + size + struct.pack("<3H2I", 0, 0, 0, 0, len(out)) + raw
        out += b"PK\3\4" + size + raw + packed
    return out + index + struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, len(parts), len(parts), len(index), len(out), 0)


@lru_cache(maxsize=64)
def deflated(body):
    """Deflated content and its checksum."""
    packer = zlib.compressobj(1, zlib.DEFLATED, -15)
    return packer.compress(body) + packer.flush(), zlib.crc32(body)


def zip_member(rng, data):
    parts = list(zip_parts(data))
    if not parts:
        return flip(rng, data)
    k = rng.randrange(len(parts))
    change = rng.random()
    if change < 0.7:
        parts[k] = parts[k][0], mutated(rng, parts[k][0], parts[k][1])
    elif change < 0.85:
        del parts[k]
    else:  # the content of another member
        parts[k] = parts[k][0], parts[rng.randrange(len(parts))][1]
    return zipped(parts)


def zip_bomb(rng, data):
    parts = list(zip_parts(data))
    if not parts:
        return data
    k = rng.randrange(len(parts))
    parts[k] = parts[k][0], parts[k][1][:128] + bytes(rng.choice((2**20, 2**23)))
    out = zipped(parts)
    if rng.random() < 0.5:  # it says it has a gigabyte
        out = out.replace(struct.pack("<I", len(parts[k][1])), struct.pack("<I", 10**9))
    return out


def zip_names(rng, data):
    parts = list(zip_parts(data))
    if not parts:
        return data
    k = rng.randrange(len(parts))
    names = ("../../x", "/abs/x", "a\nb", "C:\\x", "..\\x", "a" * 300, "con", parts[0][0], "x/", "\x1b[2J", "a/../../b")
    parts[k] = rng.choice(names), parts[k][1]
    return zipped(parts)


PACKERS = (bytes, lambda data: zlib.compress(data, wbits=31), bz2.compress, lzma.compress)
"""No compression, gzip, bzip2, xz."""


def tar_member(rng, data):
    """A tar archive with one hostile member."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        member = tarfile.TarInfo(rng.choice(("rgb.txt", "../x", "/abs/x", "a\nb", "a" * 200, "x/../../y")))
        member.type = rng.choice((tarfile.REGTYPE, tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.CHRTYPE))
        member.linkname = "/etc/passwd"
        body = bytes(rng.choice((0, 10, 2**20)))
        member.size = len(body) if member.isreg() else 0
        archive.addfile(member, io.BytesIO(body))
    packed = rng.choice(PACKERS)(out.getvalue())
    return rng.choice(RAW)(rng, packed) if rng.random() < 0.5 else packed


# -- folders -----------------------------------------------------------------------------------------------------------


def put_link(rng, home, elsewhere):
    """A link in the place of a folder, a lock or a temporary file, or beside what is there."""
    name = rng.choice(
        (".lock", "state.db", "masks", "thumbnails", "movers", "map", "tiles", "part-2", ".work", "x.part")
    )
    place = home / name
    if place.is_dir() and not place.is_symlink():
        place.rename(place.with_name(f"{name}-before"))
    elif place.exists() or place.is_symlink():
        place.unlink()
    place.symlink_to(rng.choice((elsewhere, elsewhere / "0.000000.png", "/dev/zero", "nowhere", name)))


def put_special(path, kind, secret):
    """Replace a file by something that is none."""
    path.unlink()
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind != "missing":
        target = {"zero": "/dev/zero", "loop": str(path), "dangling": "nowhere", "secret": str(secret)}[kind]
        path.symlink_to(target)
