"""Procedural textures with gradients at every scale, by seed."""

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float64]
Maker = Callable[[np.random.Generator], Image]

SIZE = 512  # must equal kernels.raytracing.TEXTURE_SIZE
HALF = SIZE // 2
LEVELS = 10


def fractal(
    rng: np.random.Generator, slope: float = 1.0, low: float = 1.0, high: float = 128.0, stretch: float = 1.0
) -> Image:
    """Periodic noise (SIZE, SIZE) of unit variance, amplitude ~ frequency^-slope between two frequencies, cycles per
    texture;

    ``stretch`` > 1 elongates along the columns.
    """
    fx = np.fft.fftfreq(SIZE, 1 / SIZE)[None, :]
    fy = np.fft.fftfreq(SIZE, 1 / SIZE)[:, None]
    frequency = np.hypot(fx, fy * stretch)
    gain = np.where((frequency >= low) & (np.hypot(fx, fy) <= high), np.maximum(frequency, 1e-9) ** (-slope - 0.5), 0.0)
    noise = np.fft.ifft2(np.fft.fft2(rng.standard_normal((SIZE, SIZE))) * gain).real
    return noise / noise.std()


def _grid() -> tuple[Image, Image]:
    axis = (np.arange(SIZE) + 0.5) / SIZE
    return np.meshgrid(axis, axis)


def _gray(values: Image, color: tuple[float, float, float] = (1, 1, 1)) -> Image:
    return values[..., None] * np.asarray(color)


def _plain(_: np.random.Generator) -> Image:
    return np.full((SIZE, SIZE, 3), 0.75)


def _noise(mean: float, *parts: tuple[float, ...], color: tuple[float, float, float] = (1, 1, 1)) -> Maker:
    def make(rng: np.random.Generator) -> Image:
        return _gray(np.asarray(sum((size * fractal(rng, *rest) for size, *rest in parts), mean)), color)

    return make


def _wallpaper(rng: np.random.Generator) -> Image:
    x, y = _grid()
    stripes = np.clip(4 * np.sin(2 * np.pi * 4 * x), -1, 1)
    image = _gray(0.70 + 0.06 * stripes, (0.98, 0.95, 0.82))
    motif = (np.mod(x * 4 + 0.25, 1) - 0.5) ** 2 + (np.mod(y * 4 + 0.5 * np.floor(x * 4 + 0.25), 1) - 0.5) ** 2
    petals = motif < 0.05 * (1 + 0.4 * np.cos(5 * np.arctan2(np.mod(y * 4, 1) - 0.5, np.mod(x * 4, 1) - 0.5)))
    image[petals] *= (0.72, 0.55, 0.55)
    return image + 0.03 * fractal(rng, 0.8, 2, 100)[..., None]


def _wood(rng: np.random.Generator) -> Image:
    _, y = _grid()
    warp = 0.05 * fractal(rng, 1.5, 1, 8)
    rings = np.sin(2 * np.pi * (y * 12 + 6 * warp + 1.5 * fractal(rng, 1.6, 1, 10, 6)))
    grain = fractal(rng, 0.6, 4, 160, 9)
    return _gray(0.55 + 0.07 * rings + 0.05 * grain, (1.0, 0.74, 0.5))


def _parquet(rng: np.random.Generator) -> Image:
    x, y = _grid()
    row = np.floor(y * 8).astype(int)
    shifted = np.mod(x + rng.random(8)[row], 1.0)
    column = np.floor(shifted * 2).astype(int)
    tone = rng.uniform(0.75, 1.15, (8, 2))[row, column]
    image = _wood(rng) * tone[..., None]
    gap = (np.mod(y * 8, 1) < 0.03) | (np.mod(shifted * 2, 1) < 0.008)
    image[gap] *= 0.45
    return image


def _rug(rng: np.random.Generator) -> Image:
    x, y = _grid()
    u, v = np.abs(x - 0.5) * 2, np.abs(y - 0.5) * 2
    ring = np.floor(np.maximum(u, v) * 7).astype(int)
    palette = rng.uniform(0.15, 0.85, (8, 3)) * (1.0, 0.75, 0.65)
    image = palette[np.clip(ring, 0, 7)]
    diamond = np.mod(np.abs(np.mod(x * 8, 1) - 0.5) + np.abs(np.mod(y * 8, 1) - 0.5), 0.5) < 0.22
    image[diamond] = 0.55 * image[diamond] + 0.45 * palette[(ring[diamond] + 3) % 8]
    return image * (1 + 0.10 * fractal(rng, 0.3, 20, 200)[..., None])


def _checks(rng: np.random.Generator) -> Image:
    x, y = _grid()
    column, row = np.floor(x * 8).astype(int), np.floor(y * 8).astype(int)
    dark = (column + row) % 2 == 0
    tone = np.where(dark, 0.28, 0.78) * rng.uniform(0.85, 1.15, (8, 8))[row, column]
    image = _gray(tone + 0.02 * fractal(rng, 0.8, 2, 60))
    image[(np.mod(x * 8, 1) < 0.03) | (np.mod(y * 8, 1) < 0.03)] = 0.5
    return image


def _brick(rng: np.random.Generator) -> Image:
    x, y = _grid()
    row = np.floor(y * 16).astype(int)
    shifted = np.mod(x + 0.0625 * (row % 2), 1.0)
    column = np.floor(shifted * 8).astype(int)
    tone = rng.uniform(0.7, 1.2, (16, 8))[row, column]
    image = _gray(0.55 * tone * (1 + 0.12 * fractal(rng, 0.5, 4, 150)), (1.0, 0.55, 0.42))
    image[(np.mod(y * 16, 1) < 0.14) | (np.mod(shifted * 8, 1) < 0.07)] = 0.68
    return image


def _poster(rng: np.random.Generator) -> Image:
    x, y = _grid()
    image = np.empty((SIZE, SIZE, 3))
    for quarter in range(4):
        top, left = HALF * (quarter // 2), HALF * (quarter % 2)
        rows, columns = slice(top, top + HALF), slice(left, left + HALF)
        u, v = np.mod(x * 2, 1)[rows, columns], np.mod(y * 2, 1)[rows, columns]
        ground = rng.uniform(0.2, 0.95, 3)
        part = np.broadcast_to(ground, (*u.shape, 3)) * (0.7 + 0.5 * v[..., None])
        for _ in range(14):
            cx, cy, size = *rng.random(2), rng.uniform(0.03, 0.2)
            color = rng.uniform(0, 1, 3)
            angle = rng.uniform(0, np.pi)
            a = (u - cx) * np.cos(angle) + (v - cy) * np.sin(angle)
            b = (v - cy) * np.cos(angle) - (u - cx) * np.sin(angle)
            inside = np.hypot(a, b) < size if rng.random() < 0.5 else (np.abs(a) < size) & (np.abs(b) < size * 0.35)
            part = np.where(inside[..., None], color, part)
        for line in range(5):
            upper = 0.74 + 0.045 * line
            ink = (v > upper) & (v < upper + 0.022) & (u > 0.1) & (u < rng.uniform(0.6, 0.92))
            letters = rng.random(64)[np.clip((u * 64).astype(int), 0, 63)] > 0.3
            part = np.where((ink & letters)[..., None], 0.05, part)
        frame = (np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v)) < 0.03)[..., None]
        image[rows, columns] = np.where(frame, 0.12, part)
    return image


def _books(rng: np.random.Generator) -> Image:
    x, y = _grid()
    image = np.full((SIZE, SIZE, 3), 0.12)
    for part, v in zip(np.split(image, 4), np.split(np.mod(y * 4, 1), 4), strict=True):
        left = 0.0
        while left < 1.0:
            width, height = rng.uniform(0.018, 0.05), rng.uniform(0.62, 0.94)
            book = slice(*np.searchsorted(x[0], (left, left + width)))  # columns, beginning with the first at or after
            pixels, across, up = part[:, book], x[: len(part), book], v[:, book]
            spine = up > 1 - height
            pixels[spine] = rng.uniform(0.1, 0.9, 3)
            label = rng.uniform(0.35, 0.6)
            band = np.abs(up - 1 + height * label) < 0.07
            band &= spine & (across > left + 0.2 * width) & (across < left + 0.8 * width)
            pixels[band] = rng.uniform(0.5, 1.0, 3)
            pixels[spine & (across < left + 0.0035)] *= 0.4
            left += width
    return image * (1 + 0.04 * fractal(rng, 0.5, 4, 100)[..., None])


def _stripes(rng: np.random.Generator) -> Image:
    x, y = _grid()
    widths = np.cumsum(rng.uniform(0.5, 2.0, 24))
    band = np.searchsorted(widths / widths[-1], y, side="left").clip(0, 23)
    palette = rng.uniform(0.2, 0.95, (6, 3))
    weave = 1 + 0.05 * np.sin(2 * np.pi * 64 * x) * np.sin(2 * np.pi * 64 * y)
    return palette[band % 6] * (weave + 0.05 * fractal(rng, 0.6, 2, 80))[..., None]


def _plaid(rng: np.random.Generator) -> Image:
    x, y = _grid()
    a, b = rng.uniform(0.35, 1.0, (16, 3)), rng.uniform(0.35, 1.0, (16, 3))
    image = a[np.floor(x * 16).astype(int)] * b[np.floor(y * 16).astype(int)] * 1.1
    return image * (1 + 0.05 * fractal(rng, 0.6, 2, 100)[..., None])


def _keyboard(rng: np.random.Generator) -> Image:
    x, y = _grid()
    u, v = np.mod(x * 16, 1), np.mod(y * 6, 1)
    key = (np.abs(u - 0.5) < 0.42) & (np.abs(v - 0.5) < 0.4)
    image = _gray(np.where(key, 0.3, 0.08))
    letters = rng.random((48, 128))[np.floor(y * 48).astype(int), np.floor(x * 128).astype(int)] > 0.55
    image[key & (np.abs(u - 0.4) < 0.2) & (np.abs(v - 0.4) < 0.2) & letters] = 0.85
    return image


def _paper(rng: np.random.Generator) -> Image:
    x, y = _grid()
    image = np.full((SIZE, SIZE, 3), 0.92)
    lines = rng.uniform(0.55, 0.95, 32)[np.floor(y * 32).astype(int)]
    letters = rng.random((32, 128))[np.floor(y * 32).astype(int), np.floor(x * 128).astype(int)] > 0.35
    image[(np.mod(y * 32, 1) > 0.4) & (x > 0.08) & (x < lines) & letters] = 0.15
    figure = (x > 0.5) & (x < 0.9) & (y > 0.3) & (y < 0.55)
    image[figure] = 0.5 + 0.25 * fractal(rng, 1.2, 2, 40)[figure][:, None] * (0.3, 0.6, 1.0)
    return image


def _paving(rng: np.random.Generator) -> Image:
    x, y = _grid()
    column, row = np.floor(x * 6 + 0.5 * (np.floor(y * 6) % 2)).astype(int) % 6, np.floor(y * 6).astype(int)
    tone = rng.uniform(0.45, 0.75, (6, 6))[row, column]
    image = _gray(tone + 0.05 * fractal(rng, 0.4, 4, 200), (1.0, 0.97, 0.92))
    gap = (np.mod(x * 6 + 0.5 * (np.floor(y * 6) % 2), 1) < 0.04) | (np.mod(y * 6, 1) < 0.04)
    image[gap] *= 0.5
    return image


def _cardboard(rng: np.random.Generator) -> Image:
    x, y = _grid()
    image = _gray(0.6 + 0.03 * fractal(rng, 0.7, 2, 100, 4), (1.0, 0.78, 0.55))
    image[np.abs(y - 0.5) < 0.05] *= (1.2, 1.2, 1.3)
    label = (np.abs(x - 0.3) < 0.15) & (np.abs(y - 0.25) < 0.1)
    letters = rng.random((64, 64))[np.floor(y * 64).astype(int), np.floor(x * 64).astype(int)] > 0.5
    image[label] = 0.92
    image[label & letters & (np.mod(y * 32, 1) > 0.5)] = 0.1
    image[(np.hypot(x - 0.75, y - 0.75) < 0.12) & (np.hypot(x - 0.75, y - 0.75) > 0.08)] = (0.7, 0.15, 0.1)
    return image


_MAKERS: dict[str, Maker] = {
    "cloud": _noise(0.5, (0.22, 1.2, 1, 24)),  # first: the shading kernel uses texture 0 for large-scale variation
    "plain": _plain,
    "plaster": _noise(0.76, (0.035, 0.7, 2, 60), (0.03, 1.0, 1, 12)),
    "wallpaper": _wallpaper,
    "wood": _wood,
    "parquet": _parquet,
    "rug": _rug,
    "checks": _checks,
    "brick": _brick,
    "poster": _poster,
    "books": _books,
    "stripes": _stripes,
    "plaid": _plaid,
    "denim": _noise(0.62, (0.08, 0.5, 3, 120, 3), (0.08, 1.2, 1, 8)),
    "skin": _noise(0.78, (0.04, 1.0, 1, 40), color=(1.0, 0.8, 0.68)),
    "keyboard": _keyboard,
    "paper": _paper,
    "grass": _noise(0.42, (0.09, 0.4, 4, 200), (0.07, 1.0, 1, 12), color=(0.7, 1.0, 0.45)),
    "paving": _paving,
    "cardboard": _cardboard,
}
TEXTURES = tuple(_MAKERS)


def build_atlas(names: set[str]) -> NDArray[np.int32]:
    """Textures with mip maps, (textures, texels of all levels) int32, 0 if unused.

    A texel is red | green << 8 | blue << 16.
    """
    atlas = np.zeros((len(TEXTURES), sum((SIZE >> level) ** 2 for level in range(LEVELS))), dtype=np.int32)
    for number, name in enumerate(TEXTURES):
        if name in names or number == 0:
            atlas[number] = _mip_maps(name)
    return atlas


@cache
def _mip_maps(name: str) -> NDArray[np.int32]:
    image = np.clip(_MAKERS[name](np.random.default_rng([0, TEXTURES.index(name)])), 0.0, 1.0)
    levels = []
    for level in range(LEVELS):
        size = SIZE >> level
        bytes_ = np.rint(image.reshape(-1, 3) * 255).astype(np.int32)
        levels.append(bytes_ @ np.array([1, 1 << 8, 1 << 16], dtype=np.int32))
        if size > 1:
            image = image.reshape(size // 2, 2, size // 2, 2, 3).mean(axis=(1, 3))
    texels = np.concatenate(levels)
    texels.flags.writeable = False
    return texels
