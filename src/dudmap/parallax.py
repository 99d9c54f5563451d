"""What moves between two images, while the map cannot tell yet.

In the first second nothing is known of free space, and whoever is in view is part of the map. Corners are followed
from image to image (Lucas and Kanade 1981) and explained by one rigid motion (RANSAC, Fischler and Bolles 1981): what
does not follow the motion of most of the visible surface moves. Errors are counted in pixels, so that a near person
counts no more than a far wall.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap import se3
from dudmap.camera import Camera
from dudmap.kernels import consensus
from dudmap.kernels.threads import bands, run_bands
from dudmap.surfaces import Pieces
from dudmap.tracker import Level

CELLS = 40
"""Corners across the image: the strongest of each cell."""
NOISE_PX = 0.7
"""A corner fits a motion if it lies within this of where the motion puts it, pixels."""
MOVES_PX = 1.0
"""A corner farther off than this,"""
MOVES_SIGMAS = 5.0
"""and than this many standard deviations (per coordinate) of the corners that follow the motion,"""
MOVES_SHARE = 0.08
"""and by this share of its own path besides (motion blur, rolling shutter), moves."""
FAR_PX = 3.0
"""Corners farther off than this say nothing of that deviation."""
RAYLEIGH = 1.1774
"""Median length of a vector of two normally distributed coordinates of deviation 1."""
FEWEST = 30
"""With fewer corners no motion is believed."""
LEAST_SHARE = 0.3
"""Nor with a smaller share of the surface that follows it."""
REACH = 0.1
"""A pixel is judged by the corners within this share of its depth, in space."""
NEIGHBOURS = 5
ALIKE, ALIKE_GREY = 1.5, 2.0
"""A window that differs by less than this times another's difference, and this many of 255 grey values, is as good."""
WINDOW = 11
"""Edge of the window a corner is recognised by, pixels."""
GUESSES = 150
FEWEST_MOVING = 3
"""Corners of a piece that must move for any of it to."""
AGREED = 0.7
"""A piece moves as a whole if at least this share of its corners does."""
COVERED = 0.5
"""Share of the readings that must move for frames to be compared however old the map is: behind a crowd it learns
nothing of free space."""
MOVED_SAY = 0.1
"""What a corner on something known to move counts, against one that is not."""
APART, LONGEST = 0.1, 0.4
"""What is too slow to be seen from one image to the next is seen over this time and more, seconds, and at most that:
the images of a young map are kept at these intervals."""
SEVERAL = 0.02
"""Share of the readings that must move for it to be more than noise."""


@dataclass(frozen=True, eq=False)
class DominantMotion:
    """The rigid motion of most of the visible surface between two images, and what does not follow it.

    Attributes:
        T_after_before: (4, 4) the static world's motion from the first camera's frame to the second's.
        moving_before, moving_after: (h, w) bool, pixels with a reading that do not follow it, in either image.
        resting_after: (h, w) bool, pieces of surface that do, by their corners; what has no corners is neither.
        share: Share of the corners, each counted by the surface it stands for, that follow it.
    """

    T_after_before: NDArray[np.float64]
    moving_before: NDArray[np.bool_]
    moving_after: NDArray[np.bool_]
    resting_after: NDArray[np.bool_]
    share: float


class Parallax:
    """Finds movers from image to image while the map is too young to know them, or most of the view is hidden.

    Args:
        seconds: Least time from the first frame on; prolonged, up to twice as long, while movers are found. 0 turns it
            off, later too.

    Attributes:
        active: Whether the next frame is to be compared with the remembered one in any case.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._until, self._longest = -np.inf, -np.inf
        self._before: tuple[Level, Level, Pieces, NDArray[np.bool_] | None] | None = None
        self._older: deque[tuple[float, NDArray[np.float64], Level, Level, Pieces]] = deque()
        self._compared: tuple[float, DominantMotion | None] | None = None  # time of the last comparison, and its result
        self.active = False

    def start(self, timestamp: float) -> None:
        """Begin with the first frame of a map."""
        self._until, self._longest = timestamp + self.seconds, timestamp + 2 * self.seconds

    def young(self, timestamp: float) -> bool:
        """Whether the map cannot know yet what moves."""
        return timestamp < self._until

    def wanted(self, timestamp: float, small: Level, moving: NDArray[np.bool_] | None) -> bool:
        """Whether a tracked frame, in which this (h, w) moves, is to be compared with the next."""
        covered = moving is not None and np.count_nonzero(moving) > COVERED * np.count_nonzero(small.depth)
        return bool(self.young(timestamp) or (covered and self.seconds > 0 and np.isfinite(self._longest)))

    def remember(
        self,
        timestamp: float,
        T_world_camera: NDArray[np.float64],
        level: Level,
        small: Level,
        surface: Pieces,
        moving: NDArray[np.bool_] | None = None,
    ) -> None:
        """Take a tracked frame, and what moves in it (h, w) bool if known, as the one to compare the next with."""
        self._before, self._compared = (level, small, surface, moving), None
        self.active = self.wanted(timestamp, small, moving)
        if not self.young(timestamp):
            self._older.clear()
        elif not self._older or timestamp - self._older[-1][0] >= APART:
            self._older.append((timestamp, T_world_camera, level, small, surface))

    def forget(self) -> None:
        """Compare no more until a frame is remembered again: the last one showed nothing."""
        self._before, self._compared, self.active = None, None, False

    def compare(self, timestamp: float, level: Level, small: Level, surface: Pieces) -> DominantMotion | None:
        """The static world's motion since the remembered frame, and what does not follow it; None if unknown.

        Asked once more for the same time, it answers without looking again.
        """
        if self._before is None:
            return None
        if self._compared is None or self._compared[0] != timestamp:
            before, small_before, surface_before, moved = self._before
            motion = dominant_motion(before, level, (small_before, small), (surface_before, surface), moved)
            self._compared = timestamp, motion
            if motion is not None and self.young(timestamp) and several(motion.moving_after, small):
                self._until = min(timestamp + self.seconds, self._longest)
        return self._compared[1]

    def slow(
        self, timestamp: float, T_world_camera: NDArray[np.float64], level: Level, small: Level, surface: Pieces
    ) -> NDArray[np.bool_]:
        """What has moved (h, w) since a somewhat older frame, as far as is known, while the map is young.

        Args:
            timestamp: Seconds, of the new frame.
            T_world_camera: (4, 4) first guess of its pose.
            level, small: The image in both resolutions.
            surface: Its pieces.
        """
        while self._older and timestamp - self._older[0][0] > LONGEST:
            self._older.popleft()
        if not self._older or timestamp - self._older[0][0] < APART or not self.young(timestamp):
            return np.zeros(small.depth.shape, dtype=bool)
        _, T_world_before, before, small_before, surface_before = self._older[0]
        T_expected = se3.inverse(T_world_camera) @ T_world_before
        both = (small_before, small), (surface_before, surface)
        motion = dominant_motion(before, level, *both, T_expected=T_expected, whole=True)
        return np.zeros(small.depth.shape, dtype=bool) if motion is None else motion.moving_after


def several(moving: NDArray[np.bool_], level: Level) -> bool:
    """Whether so many readings of an image move (h, w) that it is more than noise."""
    return bool(np.count_nonzero(moving) > SEVERAL * np.count_nonzero(level.depth))


def dominant_motion(
    before: Level,
    after: Level,
    small: tuple[Level, Level],
    surfaces: tuple[Pieces, Pieces],
    moved: NDArray[np.bool_] | None = None,
    T_expected: NDArray[np.float64] | None = None,
    whole: bool = False,
) -> DominantMotion | None:
    """Explain the corners' paths from one image to the next by one rigid motion; None where too few are left.

    The static world is what covers most *surface*, so that each corner counts by its depth squared: a crowd may fill
    half of the image, but hardly ever half of the visible square metres.

    Args:
        before, after: Both images at the resolution in which corners are followed.
        small: Both at the resolution of the result.
        surfaces: Pieces of surface of both of these.
        moved: (h, w) bool at that resolution, what is known to move in the first image; it has little say in what the
            static world is.
        T_expected: (4, 4) where the motion is looked for first; None: nowhere else than where it was.
        whole: Only pieces most of whose corners move.
    """
    first, second = (np.clip(255 * level.intensity, 0, 255).astype(np.uint8) for level in (before, after))
    pixels, targets, unlike = _followed(before, first, second, T_expected)
    if len(pixels) < FEWEST:
        return None
    columns, rows = pixels.T
    z = before.depth[rows, columns].astype(np.float64)
    points = _points(before.camera, columns, rows, z)
    surface, rests = z**2, np.ones(len(z), dtype=bool)
    if moved is not None:
        factor = before.depth.shape[1] // moved.shape[1]
        rests = ~moved[rows // factor, columns // factor]
        surface = np.where(rests, surface, MOVED_SAY * surface)
    T = _rigid_motion(points, targets, surface, before.camera)
    error = _reprojection_error(T, points, targets, before.camera)
    if np.count_nonzero(rests & (error < NOISE_PX)) < FEWEST:
        return None
    share = float(surface[error < NOISE_PX].sum() / surface.sum())
    if share < LEAST_SHARE:
        return None
    path = np.linalg.norm(targets - pixels, axis=1)
    sigma = np.median(error[error < FAR_PX]) / RAYLEIGH
    allowed = np.maximum(MOVES_PX, MOVES_SIGMAS * sigma) + MOVES_SHARE * path
    moves = error > allowed
    certain = ~moves
    certain[moves] = ~_rests_as_well(
        first, second, pixels[moves], _projected(T, points[moves], before.camera), allowed[moves], unlike[moves]
    )
    pixels, targets, points, moves = pixels[certain], targets[certain], points[certain], moves[certain]
    depth_after = after.depth[
        _inside(targets[:, 1], after.depth.shape[0]), _inside(targets[:, 0], after.depth.shape[1])
    ]
    seen = depth_after > 0
    points_after = _points(after.camera, targets[:, 0], targets[:, 1], depth_after.astype(np.float64))
    scale = small[0].camera.width / before.camera.width
    limit = np.array(small[0].depth.shape[::-1]) - 1
    places = [np.clip(np.rint((p + 0.5) * scale - 0.5), 0, limit).astype(np.int64) for p in (pixels, targets[seen])]
    return DominantMotion(
        T,
        _spread(small[0], surfaces[0], points, places[0], moves, whole),
        _spread(small[1], surfaces[1], points_after[seen], places[1], moves[seen], whole),
        _rest(surfaces[1], places[1], moves[seen]),
        share,
    )


def _followed(
    before: Level, first: NDArray[np.uint8], second: NDArray[np.uint8], T_expected: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Corners (n, 2) int of the first image, their places (n, 2) in the second, found there and back, and what differs.

    The last is the mean difference (n,) of the grey values of their windows.
    """
    import cv2

    strength = cv2.cornerMinEigenVal(first, 5)
    cell = max(6, first.shape[1] // CELLS)
    height, width = first.shape[0] // cell, first.shape[1] // cell
    tiles = strength[: height * cell, : width * cell].reshape(height, cell, width, cell).swapaxes(1, 2)
    tiles = tiles.reshape(height * width, cell * cell)
    place = tiles.argmax(axis=1)
    rows = np.arange(height * width) // width * cell + place // cell
    columns = np.arange(height * width) % width * cell + place % cell
    # a window that also shows something nearer follows that, not the surface behind
    z = before.depth[rows, columns]
    nearest = cv2.erode(
        np.where(before.depth > 0, before.depth, np.float32(np.inf)), np.ones((WINDOW, WINDOW), np.uint8)
    )
    useful = (tiles.max(axis=1) > 1e-4) & (z > 0) & (np.asarray(nearest)[rows, columns] > np.float32(0.93) * z)
    pixels = np.stack([columns, rows], axis=1)[useful]
    if len(pixels) == 0:
        return pixels, np.empty((0, 2)), np.empty(0)
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    shift = np.zeros_like(start)
    if T_expected is not None:
        points = _points(before.camera, pixels[:, 0], pixels[:, 1], z[useful].astype(np.float64))
        shift = _projected(T_expected, points, before.camera).astype(np.float32).reshape(-1, 1, 2) - start
    size, flags = (WINDOW, WINDOW), cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, unlike = cv2.calcOpticalFlowPyrLK(
        first, second, start, start + shift, winSize=size, maxLevel=3, flags=flags
    )
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(
        second, first, there, there - shift, winSize=size, maxLevel=3, flags=flags
    )
    good = (found[:, 0] > 0) & (found_back[:, 0] > 0)
    good[good] = np.linalg.norm((back - start)[good, 0], axis=1) < 0.5
    return pixels[good], there[good, 0].astype(np.float64), unlike[good, 0].astype(np.float64)


def _rests_as_well(
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    pixels: NDArray[np.int64],
    expected: NDArray[np.float64],
    allowed: NDArray[np.float64],
    unlike: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Corners (n,) that were found elsewhere, but could as well be where a static world would have put them.

    The coarse levels of the search see more than the window and follow what is nearer, and textures repeat. So the
    search is done once more, from the place of a static point on and at full size alone.

    Args:
        first, second: (h, w) uint8 images.
        pixels: (n, 2) int, corners in the first.
        expected: (n, 2) where they were if the world stood still.
        allowed: (n,) farthest from there that it still may, pixels.
        unlike: (n,) mean difference of the grey values of their windows where they were found.
    """
    import cv2

    if len(pixels) == 0:
        return np.zeros(0, dtype=bool)
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    guess = expected.astype(np.float32).reshape(-1, 1, 2)
    there, found, other = cv2.calcOpticalFlowPyrLK(
        first, second, start, guess.copy(), winSize=(WINDOW, WINDOW), maxLevel=0, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    rests = found[:, 0] > 0  # what was not found has arbitrary numbers
    near = np.linalg.norm((there - guess)[rests, 0], axis=1) < allowed[rests]
    rests[rests] = near & (other[rests, 0] < ALIKE * unlike[rests] + ALIKE_GREY)
    return rests


def _rigid_motion(
    points: NDArray[np.float64], targets: NDArray[np.float64], surface: NDArray[np.float64], camera: Camera
) -> NDArray[np.float64]:
    """Motion (4, 4) that brings most surface to its target pixels.

    Three corners give the six numbers of a small motion, linearly (Longuet-Higgins and Prazdny 1980); of many such
    guesses the one that explains most surface, counted as in MSAC (Torr and Zisserman 2000), is refined on all
    corners that follow it, with the exact projection.

    Args:
        points: (n, 3) metres, first camera's frame.
        targets: (n, 2) their pixels in the second image.
        surface: (n,) what each of them counts.
        camera: Camera of both images.
    """
    flow = targets - _projected(np.eye(4), points, camera)
    J = _flow_jacobian(points, camera)
    rng = np.random.default_rng(0)
    n = len(points)
    draws = np.concatenate([
        rng.integers(0, n, (GUESSES, 3)),
        rng.choice(n, (GUESSES, 3), p=surface / surface.sum()),
    ])  # fmt: skip
    A = J[draws].reshape(-1, 6, 6)
    A = A + 1e-9 * np.eye(6)  # corners drawn twice define nothing; such guesses explain nothing either
    guesses = np.linalg.solve(A, flow[draws].reshape(-1, 6, 1))[..., 0]
    guesses = guesses[np.linalg.norm(guesses, axis=1) < 0.5]
    guesses = np.concatenate([np.zeros((1, 6)), guesses])
    by_axis, flow_by_axis = np.ascontiguousarray(J.transpose(1, 2, 0)), np.ascontiguousarray(flow.T)
    explained = np.empty(len(guesses))
    run_bands(
        lambda start, stop: consensus.explained(
            start, stop, guesses, by_axis, flow_by_axis, surface, NOISE_PX, explained
        ),
        bands(len(guesses), 64),
    )
    T = se3.exp(guesses[int(np.argmax(explained))])
    for scale in (3.0, 2.0, 1.0, 1.0, 1.0):
        residual = targets - _projected(T, points, camera)
        kept = np.linalg.norm(residual, axis=1) < scale * NOISE_PX
        if np.count_nonzero(kept) < 6:
            break
        moved = points[kept] @ T[:3, :3].T + T[:3, 3]
        Jk = _flow_jacobian(moved, camera).reshape(-1, 6)
        step = np.linalg.lstsq(Jk, residual[kept].reshape(-1), rcond=None)[0]
        T = se3.exp(step.astype(np.float64)) @ T
    return T


def _flow_jacobian(points: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Change (n, 2, 6) of the pixels of points (n, 3) by a small twist (v, omega) of theirs."""
    z = np.maximum(points[:, 2], 1e-6)
    x, y, one, zero = points[:, 0] / z, points[:, 1] / z, np.ones_like(z), np.zeros_like(z)
    du = camera.fx * np.stack([one / z, zero, -x / z, -x * y, 1 + x * x, -y], axis=1)
    dv = camera.fy * np.stack([zero, one / z, -y / z, -1 - y * y, x * y, x], axis=1)
    return np.stack([du, dv], axis=1)


def _projected(T: NDArray[np.float64], points: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Pixels (n, 2) of moved points (n, 3)."""
    moved = points @ T[:3, :3].T + T[:3, 3]
    z = np.maximum(moved[:, 2], 1e-6)
    return np.stack([camera.fx * moved[:, 0] / z + camera.cx, camera.fy * moved[:, 1] / z + camera.cy], axis=1)


def _reprojection_error(
    T: NDArray[np.float64], points: NDArray[np.float64], targets: NDArray[np.float64], camera: Camera
) -> NDArray[np.float64]:
    """Distance (n,) in pixels of each target from where the motion puts its point."""
    return np.linalg.norm(_projected(T, points, camera) - targets, axis=1)


def _spread(
    level: Level,
    surface: Pieces,
    points: NDArray[np.float64],
    pixels: NDArray[np.int64],
    moves: NDArray[np.bool_],
    only_whole: bool = False,
) -> NDArray[np.bool_]:
    """Moving pixels (h, w): those of pieces of surface whose corners move.

    Where corners of one piece disagree, a pixel goes with most of its neighbours in space among the piece's corners.

    Args:
        level: The image.
        surface: Its pieces.
        points: (n, 3) the corners in space, metres.
        pixels: (n, 2) int, their pixels u, v.
        moves: (n,).
        only_whole: Leave the pieces whose corners disagree.
    """
    from scipy.spatial import KDTree

    if np.count_nonzero(moves) < FEWEST_MOVING:
        return np.zeros(level.depth.shape, dtype=bool)
    piece = surface.labels[pixels[:, 1], pixels[:, 0]]
    moving = np.bincount(piece[moves], minlength=surface.count + 1)
    total = np.bincount(piece, minlength=surface.count + 1)
    solid = moving >= FEWEST_MOVING
    whole = solid & (moving >= AGREED * total)
    mixed = solid & ~whole & (moving >= 0.1 * total)
    whole[0] = mixed[0] = False
    out = whole[surface.labels]
    if only_whole:
        return out
    rows, columns = np.nonzero(mixed[surface.labels] & (level.depth > 0))
    if len(rows) == 0:
        return out
    z = level.depth[rows, columns].astype(np.float64)
    apart = 1e3 * piece  # corners of other pieces are far away
    corners = np.column_stack([points, apart])
    places = np.column_stack([_points(level.camera, columns, rows, z), 1e3 * surface.labels[rows, columns]])
    distance, index = KDTree(corners).query(places, k=min(NEIGHBOURS, len(points)))
    near = distance < REACH * z[:, None]
    votes = np.where(near, np.append(np.where(moves, 1, -1), 0)[np.minimum(index, len(moves))], 0).sum(axis=1)
    out[rows, columns] = votes >= 2
    return out


def _rest(surface: Pieces, pixels: NDArray[np.int64], moves: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels (h, w) of pieces that hold enough corners at rest, and not too many others; arguments as above."""
    piece = surface.labels[pixels[:, 1], pixels[:, 0]]
    resting = np.bincount(piece[~moves], minlength=surface.count + 1)
    total = np.bincount(piece, minlength=surface.count + 1)
    rest = (resting >= FEWEST_MOVING) & (resting > (1 - AGREED) * total)
    rest[0] = False
    return rest[surface.labels]


def _points(camera: Camera, u: NDArray, v: NDArray, z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (n, 3) in the camera's frame, metres."""
    return np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1)


def _inside(coordinate: NDArray[np.float64], size: int) -> NDArray[np.int64]:
    return np.clip(np.rint(coordinate), 0, size - 1).astype(np.int64)
