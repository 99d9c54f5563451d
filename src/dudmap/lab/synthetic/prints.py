"""Textures with drawings and legible text: posters, book spines, printed paper, labels of cartons."""

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float64]
Color = tuple[int, int, int]
Box = tuple[float, float, float, float]
"""Left, top, right, bottom as shares of the page."""

INK, PAPER = (38, 36, 36), (236, 230, 217)
CLOTH: tuple[Color, ...] = (
    (92, 60, 44), (44, 56, 70), (112, 52, 48), (60, 74, 58), (202, 190, 164), (138, 110, 74), (78, 76, 76),
    (158, 128, 92), (70, 48, 58), (176, 166, 148), (40, 42, 44), (126, 132, 116),
)  # fmt: skip
"""Colours of book cloth."""
TITLES = (
    "A Winter Garden", "Atlas of Rivers", "Geometry", "Journeys North", "The Old Harbour", "Bread and Salt", "Optics",
    "Field Guide to Birds", "Essays", "The Glass Hill", "Letters from Brno", "Carpentry", "Night Trains", "Botany",
)  # fmt: skip
FONT = cv2.FONT_HERSHEY_DUPLEX
TEXT = (
    "A camera is carried through a room. It measures the distance of every surface and takes its colour. From these "
    "images its own motion is found, and a map of the room grows with every frame. People may walk through the view: "
    "they are recognised by their motion, and the map is made without them. Chairs that were moved are taken out of it "
    "and put where they stand now. In the end the room is there as it was, and nobody is in it."
)


class Page:
    """Square page that is drawn at four times its size, so that edges and letters are smooth.

    Args:
        size: Edge length of the image, pixels.
        ground: Colour of the empty page.
    """

    def __init__(self, size: int, ground: Color) -> None:
        self.size = size
        self._drawn = np.full((4 * size, 4 * size, 3), ground, dtype=np.uint8)

    def polygon(self, points: NDArray[np.float64], color: Color) -> None:
        """Fill a polygon (N, 2)."""
        cv2.fillPoly(self._drawn, [np.rint(4 * self.size * points).astype(np.int32)], color)

    def rectangle(self, box: Box, color: Color) -> None:
        """Fill a rectangle."""
        left, top, right, bottom = box
        self.polygon(np.array([[left, top], [right, top], [right, bottom], [left, bottom]]), color)

    def ellipse(self, box: Box, color: Color) -> None:
        """Fill the ellipse in a rectangle."""
        t = np.linspace(0, 2 * np.pi, 128, endpoint=False)
        ends = np.reshape(box, (2, 2))
        self.polygon(ends.mean(axis=0) + np.stack([np.cos(t), np.sin(t)], axis=1) * (ends[1] - ends[0]) / 2, color)

    def write(self, text: str, box: Box, color: Color = INK, *, upright: bool = False) -> None:
        """Stretch a line of text to a rectangle; ``upright`` text runs from top to bottom."""
        (width, height), below = cv2.getTextSize(text, FONT, 2, 3)
        mask = np.zeros((height + below, width), dtype=np.uint8)
        cv2.putText(mask, text, (0, height), FONT, 2, 255, 3, cv2.LINE_AA)
        if upright:
            mask = mask.T[:, ::-1]
        left, top, right, bottom = (round(4 * self.size * x) for x in box)
        part = self._drawn[top:bottom, left:right]
        mask = cv2.resize(mask, part.shape[1::-1], interpolation=cv2.INTER_AREA)
        part[:] = np.rint(part + mask[..., None] / 255 * (np.array(color) - part))

    def image(self) -> Image:
        """The page, (size, size, 3) in 0..1."""
        smooth = cv2.resize(self._drawn, (self.size, self.size), interpolation=cv2.INTER_AREA)
        return smooth.astype(np.float64) / 255


def posters(rng: np.random.Generator, size: int) -> Image:
    """Four framed pictures, one per quarter: mountains, a plant, a concert, a town by the sea."""
    pages = [draw(rng, size // 2) for draw in (_mountains, _plant, _concert, _town)]
    return np.vstack([np.hstack(pages[:2]), np.hstack(pages[2:])])


def _framed(page: Page) -> Image:
    """Cover the border of a page by a mount and a dark frame."""
    for width, color in ((0.07, PAPER), (0.03, (52, 42, 34))):
        for box in ((0, 0, 1, width), (0, 1 - width, 1, 1), (0, 0, width, 1), (1 - width, 0, 1, 1)):
            page.rectangle(box, color)
    return page.image()


def _mountains(rng: np.random.Generator, size: int) -> Image:
    page = Page(size, (228, 206, 176))
    for share in np.arange(24) / 24:  # from blue to the colour of the horizon
        page.rectangle((0, 0.5 * share, 1, 1), (128 + int(104 * share), 152 + int(54 * share), 168 + int(4 * share)))
    page.ellipse((0.62, 0.16, 0.76, 0.31), (240, 226, 190))
    x = np.linspace(0, 1, 65)
    for height, rough, color in (
        (0.40, 0.20, (142, 152, 160)), (0.50, 0.15, (104, 120, 130)), (0.58, 0.10, (70, 90, 92)),
        (0.67, 0.06, (52, 66, 54)),
    ):  # fmt: skip
        ridge = np.full(65, height)
        for octave in range(5):
            knots = np.linspace(0, 1, 2 ** (octave + 1) + 1)
            ridge += rough * 0.55**octave * np.interp(x, knots, rng.uniform(-0.7, 0.7, len(knots)))
        page.polygon(np.column_stack([np.r_[0, x, 1], np.r_[1, ridge, 1]]), color)
    page.rectangle((0, 0.76, 1, 1), PAPER)
    page.write("HOHE TATRA", (0.13, 0.79, 0.87, 0.87), (62, 74, 76))
    page.write("summer in the mountains by rail and on foot", (0.16, 0.89, 0.84, 0.915), (120, 92, 66))
    return _framed(page)


def _plant(rng: np.random.Generator, size: int) -> Image:
    page = Page(size, (226, 218, 198))
    t = np.linspace(-1, 1, 21)
    for pair in range(9):
        y, length = 0.72 - 0.065 * pair, 0.30 - 0.022 * pair
        for side in (-1, 1):
            along = length * (t + 1) / 2
            across = 0.045 * (1 - t**2) * (1 + 0.2 * t)
            leaf = np.column_stack([np.r_[along, along[::-1]], np.r_[across, -across[::-1]]])
            angle = np.radians(38 + 3 * pair + rng.uniform(-5, 5))
            turned = leaf @ np.array([[side * np.cos(angle), -np.sin(angle)], [-side * np.sin(angle), -np.cos(angle)]])
            tone = rng.uniform(0.75, 1.15)
            page.polygon(turned + np.array([0.5, y]), (int(78 * tone), int(98 * tone), int(70 * tone)))
    page.rectangle((0.494, 0.12, 0.506, 0.80), (84, 78, 54))
    page.write("Dryopteris filix-mas", (0.24, 0.83, 0.76, 0.865))
    page.write("plate 14   male fern", (0.36, 0.885, 0.64, 0.905), (120, 108, 90))
    return _framed(page)


def _concert(rng: np.random.Generator, size: int) -> Image:
    page = Page(size, (214, 200, 172))
    page.ellipse((0.12, 0.12, 0.62, 0.62), (156, 78, 56))
    page.ellipse((0.27, 0.27, 0.47, 0.47), (214, 200, 172))
    page.rectangle((0.46, 0.10, 0.90, 0.30), (58, 84, 92))
    page.polygon(np.array([[0.90, 0.30], [0.90, 0.74], [0.48, 0.74]]), (196, 150, 74))
    for bar in range(7):
        left = 0.12 + 0.05 * bar
        page.rectangle((left, 0.50, left + 0.02, 0.55 + rng.uniform(0.05, 0.19)), INK)
    page.write("KONZERT", (0.12, 0.76, 0.66, 0.86))
    page.write("Dvorak  Janacek  Martinu", (0.12, 0.885, 0.66, 0.915))
    page.write("12. 5.", (0.70, 0.79, 0.88, 0.86), (156, 78, 56))
    return _framed(page)


def _town(rng: np.random.Generator, size: int) -> Image:
    page = Page(size, (176, 190, 192))
    walls: tuple[Color, ...] = ((204, 178, 138), (190, 140, 112), (222, 212, 190), (166, 170, 152), (208, 160, 120))
    for row, top in enumerate((0.26, 0.42)):
        left = -0.05
        while left < 1:
            width, roof = rng.uniform(0.11, 0.17), top + rng.uniform(-0.07, 0.07)
            page.rectangle((left, roof, left + width, 0.82), walls[rng.integers(5)])
            tip = [[left - 0.01, roof], [left + width / 2, roof - 0.06], [left + width + 0.01, roof]]
            page.polygon(np.array(tip), (138, 78, 58) if row else (122, 84, 68))
            for v in np.arange(roof + 0.03, 0.78, 0.07):
                for u in (0.2, 0.58):
                    page.rectangle((left + u * width, v, left + (u + 0.22) * width, v + 0.035), (74, 78, 84))
            left += width + rng.uniform(0.0, 0.01)
    page.rectangle((0, 0.74, 1, 1), (66, 92, 104))
    for _ in range(40):
        u, v = rng.uniform(0, 0.95), rng.uniform(0.75, 0.82)
        page.rectangle((u, v, u + 0.06, v + 0.004), (120, 142, 148))
    page.write("LISBOA", (0.28, 0.835, 0.72, 0.915), PAPER)
    return _framed(page)


def books(rng: np.random.Generator, size: int) -> Image:
    """Four shelves of cloth-bound books with their titles on the spines."""
    page, number = Page(size, (26, 22, 20)), 0
    for shelf in range(4):
        left = 0.0
        while left < 1.0:
            width, height = rng.uniform(0.018, 0.05), 0.25 * rng.uniform(0.66, 0.94)
            number = (number + int(rng.integers(1, len(CLOTH)))) % len(CLOTH)
            top, right = 0.25 * (shelf + 1) - height, min(left + width, 1.0) - 0.0012
            page.rectangle((left, top, right, top + height - 0.001), CLOTH[number])
            light = (222, 202, 150) if sum(CLOTH[number]) < 330 else INK
            for line in (0.05, 0.075, 0.92):
                page.rectangle((left, top + line * height, right, top + line * height + 0.0025), light)
            if width > 0.022:
                title = TITLES[rng.integers(len(TITLES))]
                start, length = top + 0.12 * height, min(0.75 * height, 0.3 * width * len(title))
                page.write(
                    title, (left + 0.23 * width, start, left + 0.77 * width, start + length), light, upright=True
                )
            left += width
    return page.image()


def paper(rng: np.random.Generator, size: int) -> Image:
    """A printed page: a title, two columns of text, and a chart."""
    page, words = Page(size, (238, 236, 230)), TEXT.split()
    page.write("Mapping a room in which people walk", (0.08, 0.06, 0.92, 0.105))
    lines = [(x, 0.15 + 0.027 * n) for x in (0.08, 0.53) for n in range(30) if x < 0.5 or not 3 < n < 16]
    for number, (left, top) in enumerate(lines):
        line = " ".join(words[(6 * number + k) % len(words)] for k in range(6))
        page.write(line, (left, top, left + 0.39 * min(len(line) / 36, 1.0), top + 0.017), (52, 52, 56))
    for bar in range(9):
        left = 0.54 + 0.042 * bar
        page.rectangle((left, 0.56 - rng.uniform(0.06, 0.27), left + 0.03, 0.56), (86, 108, 122))
    return page.image()


def carton(size: int, label: Color = PAPER) -> Image:
    """Tape, a label with an address and a printed warning on brown cardboard."""
    page = Page(size, (166, 130, 92))
    page.rectangle((0, 0.45, 1, 0.55), (186, 152, 114))
    page.rectangle((0.12, 0.12, 0.46, 0.36), label)
    for row, line in enumerate(("Library of Moravia", "Box 12, Atlases", "from Brno to Olomouc")):
        page.write(line, (0.15, 0.15 + 0.065 * row, 0.40, 0.19 + 0.065 * row))
    page.write("FRAGILE", (0.55, 0.68, 0.93, 0.80), (122, 56, 44))
    page.write("THIS SIDE UP", (0.57, 0.84, 0.91, 0.88), (122, 56, 44))
    return page.image()
