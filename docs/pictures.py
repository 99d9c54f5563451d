"""Draw the pictures of docs/concepts.md from the synthetic worlds, with the system's own classes.

python docs/pictures.py [FOLDER]     # by default docs/images; takes a minute
"""

import io
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from PIL import Image

from dudmap import Camera, Slam
from dudmap.core.backends.cpu.evidence import BINS, MAX_RESIDUAL
from dudmap.core.geometry import se3
from dudmap.core.map.volume import FREE, TsdfVolume
from dudmap.core.places.pose_graph import Edge, optimize
from dudmap.core.result import FrameResult
from dudmap.fleet.map_samples import EMPTY, OBSERVED, sample_map
from dudmap.lab import synthetic

IMAGES = Path(__file__).parent / "images"
CAMERA = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
GREY, SKY = "#d9d9d9", "#dcebf7"


def main() -> None:
    """Write all pictures into the named folder, by default into the documentation."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else IMAGES
    for name, figure in (
        ("concept-tsdf.png", tsdf_slice()),
        ("concept-labels.png", labels()),
        ("concept-pose-graph.png", pose_graph()),
    ):
        drawn = io.BytesIO()
        figure.savefig(drawn, dpi=100)
        Image.open(drawn).convert("RGB").quantize(256).save(folder / name, optimize=True)
        print(f"{folder / name}: {(folder / name).stat().st_size / 1e3:.0f} kB")


def tsdf_slice() -> Figure:
    """Vertical slice through the signed distances of a map of an empty room after 30 frames; whole, and a part."""
    sequence = synthetic.sequence("room", movers=(), frames=30, camera=CAMERA, noise="kinect", seed=0)
    volume = TsdfVolume(CAMERA)
    poses = sequence.ground_truth.Ts_world_camera
    for index in range(len(sequence)):
        volume.integrate(sequence[index], poses[index])
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    whole, part = figure.subplots(1, 2, width_ratios=[1.55, 1])
    view = poses[len(poses) // 2]
    _slice(whole, volume, view, (-0.2, 5.2), (-1.7, 1.7), 0.01)
    drawn = _slice(part, volume, view, *ZOOM, 0.002)
    half = CAMERA.height / (2 * CAMERA.fy)
    whole.plot([0.5, 0, 0.5], [-0.5 * half, 0, 0.5 * half], color="black", linewidth=1)
    whole.plot(0, 0, "o", color="black")
    for text, place in (("camera", (-0.12, -0.3)), ("known to be free", (1.3, 0.1)), ("not seen", (0.5, 1.35))):
        whole.annotate(text, place)
    whole.add_patch(Rectangle((ZOOM[0][0], ZOOM[1][0]), np.ptp(ZOOM[0]), np.ptp(ZOOM[1]), fill=False, linestyle="--"))
    whole.set_title("A vertical slice through the map")
    part.set_title("The dashed part: black is the surface")
    figure.colorbar(drawn, ax=part, label="signed distance, cm", shrink=0.9)
    return figure


ZOOM = ((2.65, 3.45), (-0.3, 0.5))
"""Part of the slice that is drawn larger: depth and height in the view, metres."""


def _slice(axes, volume, view, depths, heights, step):
    z, y = np.meshgrid(np.arange(*depths, step), np.arange(*heights, step))
    points = np.stack([np.zeros(z.size), y.ravel(), z.ravel()], axis=1) @ view[:3, :3].T + view[:3, 3]
    samples = sample_map(volume, points)
    distance = np.where(samples.state == OBSERVED, samples.sdf, np.nan).reshape(z.shape)
    extent = (*depths, *heights)
    ground = (samples.state == EMPTY).reshape(z.shape)
    axes.imshow(ground, origin="lower", extent=extent, cmap=ListedColormap([GREY, SKY]), vmin=0, vmax=1)
    limit = 100 * volume.truncation
    drawn = axes.imshow(100 * distance, origin="lower", extent=extent, cmap="RdBu", vmin=-limit, vmax=limit)
    axes.contour(z, y, distance, levels=[0.0], colors="black", linewidths=1.2)
    axes.set(xlabel="z, m (along the view)", ylabel="y, m (down)")
    axes.set_ylim(heights[1], heights[0])
    return drawn


def labels() -> Figure:
    """From residuals to labels: one frame with a walking person."""
    sequence = synthetic.sequence("room", movers=("person",), frames=60, camera=CAMERA, noise="kinect", seed=0)
    slam = Slam(CAMERA)
    best, coverage = None, 0.0
    for index in range(len(sequence)):
        result = slam.process(sequence[index])
        share = float(sequence.mask(index).mean())
        if result._labels is not None and result._labels.mixture is not None and share > coverage:
            best, coverage = (index, result), share
    assert best is not None
    index, result = best
    return _draw_labels(sequence[index].color, sequence.mask(index), result)


def _draw_labels(color: NDArray[np.uint8], true_mask: NDArray[np.bool_], result: FrameResult) -> Figure:
    found = result._labels
    assert found is not None
    assert found.mixture is not None
    figure = Figure(figsize=(10.5, 6.4), layout="constrained")
    axes = figure.subplots(2, 3)
    _image(axes[0, 0], "1. colour of a frame", color)
    shown = _image(
        axes[0, 1], "2. distance of the readings to the map", 100 * result.residuals, cmap="RdBu", vmin=-5, vmax=5
    )
    figure.colorbar(shown, ax=axes[0, 1], label="cm", shrink=0.7)
    occupancy = found.sample.occupancy
    kinds = ListedColormap([GREY, "#d7301f"])
    _image(axes[0, 2], "3. readings in space known to be free (red)", occupancy == FREE, cmap=kinds, vmin=0, vmax=1)
    centres = (np.arange(BINS) + 0.5) * MAX_RESIDUAL / BINS
    total = found.histogram.sum() * MAX_RESIDUAL / BINS
    axes[1, 0].bar(centres, found.histogram / total, width=MAX_RESIDUAL / BINS, color=GREY)
    for density, name, hue in zip(
        found.mixture.density(centres), ("static", "moves"), ("#2171b5", "#d7301f"), strict=True
    ):
        axes[1, 0].plot(centres, density, label=name, color=hue)
    axes[1, 0].set(title="4. two densities fitted by EM", xlabel="|residual| / its standard deviation", yscale="log")
    axes[1, 0].set_ylim(1e-4, 4)
    axes[1, 0].legend()
    shown = _image(axes[1, 1], "5. probability of being static", found.static_probability, cmap="gray", vmin=0, vmax=1)
    figure.colorbar(shown, ax=axes[1, 1], shrink=0.7)
    overlaid = color.copy()
    overlaid[result.dynamic_mask] = overlaid[result.dynamic_mask] // 2 + np.array([127, 0, 0], dtype=np.uint8)
    _image(axes[1, 2], "6. the mask (red) and the truth (green line)", overlaid)
    axes[1, 2].contour(true_mask, levels=[0.5], colors="lime", linewidths=1)
    return figure


def _image(axes, title, image, **options):
    axes.set_title(title, fontsize=10)
    axes.set_axis_off()
    return axes.imshow(image, interpolation="nearest", **options)


def pose_graph() -> Figure:
    """A round trip whose drift one loop closure removes, with the optimizer of the system."""
    rng = np.random.default_rng(4)
    angles = np.linspace(0, 2 * np.pi, 61)
    true = np.stack([_pose(2 * np.cos(a) - 2, 1.4 * np.sin(a), a) for a in angles])
    drift = np.array([0.004, 0, 0.003, 0, np.radians(0.35), 0])
    steps = [se3.inverse(a) @ b @ se3.exp(drift + rng.normal(0, 0.002, 6)) for a, b in pairwise(true)]
    driven = [true[0]]
    for step in steps:
        driven.append(driven[-1] @ step)
    edges = [Edge(i, i + 1, step, 0.01, np.radians(0.5)) for i, step in enumerate(steps)]
    loop = Edge(0, len(true) - 1, se3.inverse(true[0]) @ true[-1], 0.005, np.radians(0.2))
    corrected = optimize(np.stack(driven), [*edges, loop])
    figure = Figure(figsize=(8.6, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, Ts, title in (
        (left, np.stack(driven), "tracked: drift adds up"),
        (right, corrected, "after optimization"),
    ):
        axes.plot(true[:, 0, 3], true[:, 2, 3], color="#aaaaaa", linewidth=4, label="true path")
        axes.plot(Ts[:, 0, 3], Ts[:, 2, 3], ".-", color="#2171b5", label="poses and their edges")
        axes.plot(
            Ts[[0, -1], 0, 3], Ts[[0, -1], 2, 3], color="#d7301f", linewidth=2, label="edge of the recognised place"
        )
        axes.set(title=title, xlabel="x, m", ylabel="z, m", aspect="equal")
    left.legend(fontsize=8, loc="center")
    return figure


def _pose(x: float, z: float, angle: float) -> NDArray[np.float64]:
    """Pose (4, 4) at (x, 0, z), turned about the y axis."""
    T = se3.exp(np.array([0, 0, 0, 0, -angle, 0]))
    T[:3, 3] = x, 0, z
    return T


if __name__ == "__main__":
    main()
