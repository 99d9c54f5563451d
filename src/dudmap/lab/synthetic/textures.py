"""Procedural textures with gradients at every scale, by seed."""

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from dudmap.lab.synthetic import prints

Image = NDArray[np.float64]
Maker = Callable[[np.random.Generator], Image]

SIZE = 512  # must equal kernels.raytracing.TEXTURE_SIZE
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
    """Pale stripes with painted sprigs, each of which leans, spreads and is tinted in its own way."""
    x, y = _grid()
    image = _gray(0.72 + 0.025 * np.clip(4 * np.sin(2 * np.pi * 8 * x), -1, 1), (1.0, 0.96, 0.87))
    column = np.floor(x * 4).astype(int)
    down = np.mod(y * 4 + 0.5 * (column % 2), 4)
    u, v = np.mod(x * 4, 1) - 0.5, np.mod(down, 1) - 0.5
    lean, spread, tint = rng.uniform(-1, 1, (3, 4, 4))[:, np.floor(down).astype(int), column]
    u = u - 0.25 * lean * (0.3 - v)
    image[(np.abs(u - 0.03 * np.sin(9 * v)) < 0.014) & (np.abs(v) < 0.34)] *= (0.50, 0.52, 0.46)
    leaf = np.stack([0.50 + 0.12 * tint, 0.56 + 0.10 * tint, 0.47 + 0.11 * tint], axis=-1)
    for k in range(4):
        for side in (-1, 1):
            a, b = side * u, 0.20 - 0.14 * k - v  # along the leaf's axis, which rises by 45 degrees
            along, across = (a + b) / np.sqrt(2) - 0.13, (b - a) / np.sqrt(2)
            inside = (along / (0.115 + 0.02 * spread)) ** 2 + (across / (0.05 - 0.015 * side * lean)) ** 2 < 1
            image[inside] *= leaf[inside] * (1.04 if k % 2 else 0.92)
    return image + 0.035 * fractal(rng, 0.8, 2, 100)[..., None]


def _wood(rng: np.random.Generator) -> Image:
    """Oak: slowly wandering year rings, seen along the grain, and fine pores."""
    _, y = _grid()
    rings = np.mod(y * 9 + 0.9 * fractal(rng, 1.5, 1, 8, 5), 1.0)
    grain, pores = fractal(rng, 0.7, 6, 200, 10), fractal(rng, 0.2, 40, 250, 14)
    return _gray(0.62 - 0.12 * rings**2 + 0.06 * grain - 0.05 * np.maximum(pores - 0.8, 0), (1.0, 0.79, 0.57))


def _parquet(rng: np.random.Generator) -> Image:
    x, y = _grid()
    row = np.floor(y * 8).astype(int)
    shifted = np.mod(x + rng.random(8)[row], 1.0)
    column = np.floor(shifted * 2).astype(int)
    tone = rng.uniform(0.8, 1.12, (8, 2))[row, column]
    cut = rng.integers(SIZE, size=(2, 8, 2))[:, row, column]  # every plank is of another part of the wood
    wood = _wood(rng)[tuple(np.mod(np.indices((SIZE, SIZE)) + cut, SIZE))]
    image = wood * tone[..., None] * (0.97, 0.92, 0.86)
    gap = (np.mod(y * 8, 1) < 0.03) | (np.mod(shifted * 2, 1) < 0.008)
    image[gap] *= 0.45
    return image


def _rug(rng: np.random.Generator) -> Image:
    """Woven rug: borders around a field of diamonds in madder, indigo, ochre and wool."""
    x, y = _grid()
    u, v = np.abs(x - 0.5) * 2, np.abs(y - 0.5) * 2
    ring = np.searchsorted((0.58, 0.63, 0.80, 0.85, 0.94), np.maximum(u, v))
    wool = np.array([(0.47, 0.23, 0.19), (0.68, 0.60, 0.47), (0.22, 0.26, 0.33), (0.62, 0.47, 0.29)])
    image = wool[np.array([0, 1, 2, 3, 0, 2])[ring]]
    diamond = np.abs(np.mod(x * 12, 1) - 0.5) + np.abs(np.mod(y * 12, 1) - 0.5)
    image[(diamond < 0.3) & np.isin(ring, (0, 2, 4))] = 0.8 * wool[1]
    image[(diamond < 0.14) & np.isin(ring, (0, 2, 4))] = wool[2]
    medallion = np.hypot(u, v) + 0.04 * np.cos(8 * np.arctan2(y - 0.5, x - 0.5))
    for radius, color in ((0.42, 2), (0.37, 3), (0.30, 1), (0.22, 0), (0.10, 1)):
        image[medallion < radius] = wool[color]
    return image * (1 + 0.10 * fractal(rng, 0.3, 20, 200)[..., None])


def _checks(rng: np.random.Generator) -> Image:
    """Tiles of dark and pale stone."""
    x, y = _grid()
    column, row = np.floor(x * 8).astype(int), np.floor(y * 8).astype(int)
    dark = (column + row) % 2 == 0
    tone = np.where(dark, 0.27, 0.77) * rng.uniform(0.88, 1.12, (8, 8))[row, column]
    image = _gray(tone + 0.025 * fractal(rng, 0.8, 2, 60), (1.0, 0.97, 0.91))
    image[(np.mod(x * 8, 1) < 0.03) | (np.mod(y * 8, 1) < 0.03)] = (0.52, 0.50, 0.47)
    return image


def _brick(rng: np.random.Generator) -> Image:
    x, y = _grid()
    row = np.floor(y * 16).astype(int)
    shifted = np.mod(x + 0.0625 * (row % 2), 1.0)
    column = np.floor(shifted * 8).astype(int)
    tone = rng.uniform(0.7, 1.2, (16, 8))[row, column]
    image = _gray(0.55 * tone * (1 + 0.12 * fractal(rng, 0.5, 4, 150)), (1.0, 0.62, 0.50))
    image[(np.mod(y * 16, 1) < 0.14) | (np.mod(shifted * 8, 1) < 0.07)] = 0.68
    return image


def _stripes(rng: np.random.Generator) -> Image:
    x, y = _grid()
    widths = np.cumsum(rng.uniform(0.5, 2.0, 24))
    band = np.searchsorted(widths / widths[-1], y, side="left").clip(0, 23)
    yarn = np.array([
        (0.82, 0.77, 0.68), (0.34, 0.42, 0.50), (0.72, 0.70, 0.64), (0.52, 0.57, 0.47), (0.80, 0.74, 0.62),
        (0.58, 0.40, 0.33),
    ])  # fmt: skip
    weave = 1 + 0.05 * np.sin(2 * np.pi * 64 * x) * np.sin(2 * np.pi * 64 * y)
    return yarn[band % 6] * (weave + 0.05 * fractal(rng, 0.6, 2, 80))[..., None]


def _plaid(rng: np.random.Generator) -> Image:
    """Tartan: warp and weft of the same bands of wool, woven as a twill."""
    wool = np.array([(0.62, 0.58, 0.50), (0.36, 0.41, 0.42), (0.74, 0.70, 0.62), (0.46, 0.33, 0.29)])
    bands = wool[np.array([0, 0, 1, 1, 1, 2, 1, 1, 1, 0, 0, 0, 3, 2, 3, 0])].repeat(SIZE // 16, axis=0)
    row, column = np.indices((SIZE, SIZE))
    over = np.where((row + column) // 2 % 2 == 0, 0.7, 0.3)[..., None]
    image = over * bands[None] + (1 - over) * bands[:, None]
    return image * (1 + 0.05 * fractal(rng, 0.6, 2, 100)[..., None])


def _linen(rng: np.random.Generator) -> Image:
    """Plain cloth: thick and thin threads along both directions."""
    threads = fractal(rng, 0.4, 8, 200, 12) + fractal(rng, 0.4, 8, 200, 12).T
    return _gray(0.68 + 0.045 * threads + 0.03 * fractal(rng, 1.2, 1, 8), (1.0, 0.97, 0.92))


def _keyboard(rng: np.random.Generator) -> Image:
    x, y = _grid()
    u, v = np.mod(x * 16, 1), np.mod(y * 6, 1)
    key = (np.abs(u - 0.5) < 0.42) & (np.abs(v - 0.5) < 0.4)
    image = _gray(np.where(key, 0.3, 0.08))
    letters = rng.random((48, 128))[np.floor(y * 48).astype(int), np.floor(x * 128).astype(int)] > 0.55
    image[key & (np.abs(u - 0.4) < 0.2) & (np.abs(v - 0.4) < 0.2) & letters] = 0.85
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
    return prints.carton(SIZE) * (1 + 0.05 * fractal(rng, 0.7, 2, 100, 4)[..., None])


def _poster(rng: np.random.Generator) -> Image:
    """Lithographs: the stone leaves its grain in the colour."""
    return prints.posters(rng, SIZE) * (1 + 0.06 * fractal(rng, 0.9, 3, 40)[..., None])


def _books(rng: np.random.Generator) -> Image:
    return prints.books(rng, SIZE) * (1 + 0.04 * fractal(rng, 0.5, 4, 100)[..., None])


_MAKERS: dict[str, Maker] = {
    "cloud": _noise(0.5, (0.22, 1.2, 1, 24)),  # first: the shading kernel uses texture 0 for large-scale variation
    "plain": _plain,
    "plaster": _noise(0.76, (0.035, 0.7, 2, 60), (0.03, 1.0, 1, 12), color=(1.0, 0.985, 0.95)),
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
    "paper": lambda rng: prints.paper(rng, SIZE),
    "grass": _noise(0.42, (0.09, 0.4, 4, 200), (0.07, 1.0, 1, 12), color=(0.78, 0.95, 0.52)),
    "paving": _paving,
    "cardboard": _cardboard,
    "linen": _linen,
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
