"""Colour and depth among numbered images, by names and content.

A series is the images of one folder whose names differ by numbers alone. Words in names decide; if ambiguous or
contradicted, one channel of 16 bits or floats is depth, 8-bit colours are colour.
"""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path

import numpy as np

from dudmap.errors import DatasetError
from dudmap.io.sequences.camera_files import IMAGES
from dudmap.io.sequences.image_headers import kind_of
from dudmap.io.sequences.image_numbers import NUMBER, count_pairs, last_number

WORDS = {"color": ("color", "colour", "rgb", "left", "image", "img", "mono"), "depth": ("depth",)}
NEITHER = {"right", "vis", "ir", "seg", "flow"}
NEITHER_STARTS = "confid", "mask", "normal", "label", "instance", "semantic", "segment", "dispar", "infra", "thermal"
CONTENTS = {
    "depth": "one channel of 16 bits or floats", "color": "8-bit colours", "gray": "8-bit intensities",
    "other": "palettes or other values", "": "content that differs or cannot be read",
}  # fmt: skip
PROBED = 3
LEAST_SHARE = 0.25
"""Smallest share with a partner of the longer of two series paired by content, and of its kind in a series that
replaces another."""
LARGEST_LIST = 5
Found = dict[str, "Series | None"]


@dataclass
class Series:
    """Images of one folder whose names differ by numbers.

    Attributes:
        kind: ``depth``, ``color``, ``neither``, or empty: by names, else by content.
    """

    label: str
    files: list[Path]
    kind: str = ""

    @cached_property
    def content(self) -> str:
        """Kind of the values (``image_headers.content``); empty if mixed or unreadable."""
        sampled = {self.files[k] for k in np.linspace(0, len(self.files) - 1, PROBED).astype(int)}
        kinds = {kind for file in sampled if (kind := kind_of(file))}
        return kinds.pop() if len(kinds) == 1 else ""

    @property
    def fits(self) -> bool:
        """Whether content and names agree."""
        return self.content not in {"depth": ("color", "gray", "other"), "color": ("depth",)}.get(self.kind, ())

    def may_be(self, kind: str) -> bool:
        """Whether the content is of a kind; colourised depth does not count."""
        if self.kind == "neither" or (kind, self.kind) == ("color", "depth"):
            return False
        return self.content == kind or (kind == self.kind == "color" and self.content == "gray")

    def rank(self, kind: str) -> tuple[bool, list[bool]]:
        """Sort key: surest names first."""
        return self.kind != kind, [word not in self.label.lower() for word in WORDS[kind]]

    def __str__(self) -> str:
        return f"{self.label} ({len(self.files)} with {CONTENTS[self.content]})"


def is_numbered_image(name: str) -> bool:
    """Whether a name is a numbered image's."""
    stem, suffix = os.path.splitext(name)
    return suffix.lower() in IMAGES and not name.startswith(".") and re.search(r"\d", stem) is not None


def kind_by_name(name: str) -> str:
    """``depth``, ``color``, ``neither``, or empty, by words."""
    words = re.findall("[a-z]+", name.lower())
    if any(word in NEITHER or word.startswith(NEITHER_STARTS) for word in words):
        return "neither"
    text = " ".join(words)
    return next((kind for kind in ("depth", "color") if any(word in text for word in WORDS[kind])), "")


def find(path: Path, patterns: Mapping[str, str | None] | None = None) -> Found:
    """Colour and depth images by patterns, names or content; may be empty.

    Raises:
        DatasetError: A pattern matches nothing, or several series match.
    """
    given = {kind: _matching(path, kind, pattern) for kind, pattern in (patterns or {}).items() if pattern}
    found = by_names(path) | given
    if len(given) == len(WORDS) or all(one is not None and one.fits for one in found.values()):
        return found
    return by_content(path, given) or alone(path, given)


def by_names(path: Path) -> Found:
    """Images by words in names: in the folder, else in one subfolder each."""
    own = _series_in(path)
    found = {kind: _surest(own, kind) for kind in WORDS}
    if (depth := found["depth"]) and not found["color"]:  # 0001.jpg is the colour of 0001_depth.png
        stems = {re.sub(r"[\W_]*depth[\W_]*", "", file.stem, flags=re.IGNORECASE) for file in depth.files}
        alike = [file for one in own for file in one.files if file.stem in stems]
        found["color"] = Series("N", alike, "color") if alike else None
    if all(found.values()):
        return found
    named = [series for name, series in _folders(path) if kind_by_name(name) in WORDS and not _is_recording(series)]
    return {kind: _surest([one for series in named for one in series], kind) for kind in WORDS}


def by_content(path: Path, given: dict[str, Series] | None = None) -> Found:
    """Pairs of images, by content if names are ambiguous; a subfolder with both kinds is a separate recording.

    Raises:
        DatasetError: Several series may be meant.
    """
    own, folders = _series_in(path), [_below(path / name, f"{name}/") for name in _folder_names(path)]
    found = _best(path, own, given or {})
    if found or (not given and any(_is_recording(series) for series in folders)):
        return found
    return _best(path, [*own, *(one for series in folders for one in series)], given or {})


def alone(path: Path, given: dict[str, Series] | None = None) -> Found:
    """Depth images of a folder without possible colour.

    Raises:
        DatasetError: Several series may be meant.
    """
    series = _everything(path)
    if "color" in (given or {}) or any(
        one.content in ("color", "gray") and one.kind in ("color", "") for one in series
    ):
        return {}
    meant = [(given or {})["depth"]] if given else [one for one in series if one.may_be("depth")]
    best = [one for one in meant if one.rank("depth") == min(other.rank("depth") for other in meant)]
    return {"color": None, "depth": _only(path, "depth", best)} if best else {}


def unknown(path: Path) -> str:
    """Sentence on unrecognised images; empty if there are none."""
    there = _there(path)
    return there and (
        f"{path} holds images in no known layout: {there}; expected colour images of 8 bit and depth images of 16 bit "
        "or floats with equal numbers: name the files with --color PATTERN and --depth PATTERN, such as --depth "
        "'FOLDER/*.png'"
    )


def listed(series: list[Series]) -> str:
    """Some series for a message, the longest first."""
    texts = [str(one) for one in sorted(series, key=lambda one: -len(one.files))]
    return ", ".join(texts[:LARGEST_LIST]) + (f" and {len(texts) - LARGEST_LIST} more" * (len(texts) > LARGEST_LIST))


def _series_in(folder: Path, name: str = "") -> list[Series]:
    found: dict[str, list[Path]] = {}
    for file in sorted(os.listdir(folder)):
        if is_numbered_image(file):
            stem, suffix = os.path.splitext(file)
            found.setdefault(re.sub(NUMBER, "N", stem) + suffix, []).append(folder / file)
    word, series = kind_by_name(name), [Series(name + pattern, files) for pattern, files in found.items()]
    for pattern, one in zip(found, series, strict=True):
        kinds = {kind_by_name(os.path.splitext(pattern)[0]), word} - {""}
        if kinds == set(WORDS):
            kinds = {{"depth": "depth", "color": "color", "gray": "color"}.get(one.content, word)}
        one.kind = "neither" if "neither" in kinds else next(iter(kinds), "")
    return series


def _folders(path: Path) -> list[tuple[str, list[Series]]]:
    found = []
    for name in _folder_names(path):
        series, below = _series_in(path / name, f"{name}/"), _folder_names(path / name)
        if not series and len(below) == 1:
            series = _series_in(path / name / below[0], f"{name}/{below[0]}/")
        found.append((name, series))
    return found


def _below(folder: Path, name: str) -> list[Series]:
    further = [_series_in(folder / inner, f"{name}{inner}/") for inner in _folder_names(folder)]
    return [*_series_in(folder, name), *(one for series in further for one in series)]


def _folder_names(path: Path) -> list[str]:
    with os.scandir(path) as entries:
        return sorted(entry.name for entry in entries if entry.is_dir() and not entry.name.startswith("."))


def _matching(path: Path, kind: str, pattern: str) -> Series:
    files = [file for file in sorted(path.glob(pattern)) if is_numbered_image(file.name)]
    if not files:
        raise DatasetError(
            f"no numbered image in {path} matches --{kind} {pattern}; there are {_there(path) or 'none at all'}"
        )
    return Series(pattern, files, kind)


def _there(path: Path) -> str:
    return listed(_everything(path))


def _everything(path: Path) -> list[Series]:
    return [*_series_in(path), *(one for name in _folder_names(path) for one in _below(path / name, f"{name}/"))]


def _surest(series: list[Series], kind: str) -> Series | None:
    known = [one for one in series if one.kind == kind]
    enough = LEAST_SHARE * max((len(one.files) for one in known), default=0)
    known.sort(
        key=lambda one: (
            not one.fits or len(one.files) < enough,
            one.rank(kind)[1],
            one.files[0].parent,
            -len(one.files),
        )
    )
    if not known:
        return None
    files, taken = list(known[0].files), {last_number(file) for file in known[0].files}
    for one in known[1:]:
        numbers = {last_number(file) for file in one.files}
        if one.files[0].parent == files[0].parent and one.fits == known[0].fits and not taken & numbers:
            files, taken = [*files, *one.files], taken | numbers
    return Series(known[0].label, sorted(files), kind)


def _is_recording(series: list[Series]) -> bool:
    return all(any(one.may_be(kind) for one in series) for kind in WORDS)


def _best(path: Path, series: list[Series], given: dict[str, Series]) -> Found:
    """The two series with the surest names, then most pairs; a ``DatasetError`` if several are alike."""
    candidates = ([given[kind]] if kind in given else [one for one in series if one.may_be(kind)] for kind in WORDS)
    found: list[tuple[tuple, dict[str, Series]]] = []
    for color, depth in product(*candidates):
        count = count_pairs(color.files, depth.files)
        if count >= LEAST_SHARE * max(len(color.files), len(depth.files)):
            found.append(((color.rank("color"), depth.rank("depth"), -count), {"color": color, "depth": depth}))
    best = min((rank for rank, _ in found), default=None)
    alike = [pair for rank, pair in found if rank == best]
    if not alike:
        return {}
    return {kind: _only(path, kind, [pair[kind] for pair in alike]) for kind in WORDS}


def _only(path: Path, kind: str, meant: list[Series]) -> Series:
    different = list({id(one): one for one in meant}.values())
    if len(different) > 1:
        raise DatasetError(
            f"{path} holds {len(different)} sets of images that may be the {kind} images: {listed(different)}; name "
            f"them with --{kind} PATTERN"
        )
    return different[0]
