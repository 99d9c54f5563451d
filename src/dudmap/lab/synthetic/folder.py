"""Writer of synthetic recordings in TUM layout with ground truth."""

import json
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError
from dudmap.lab.synthetic.recording import SyntheticSequence
from dudmap.version import __version__

PENDING = 8


def write_folder(
    sequence: SyntheticSequence,
    out: str | Path,
    *,
    overwrite: bool = False,
    surface: bool = True,
    progress: Callable[[int], None] | None = None,
) -> Path:
    """Render all frames into a folder:

    - rgb/, depth/ (16 bit, ``camera.depth_scale`` units per metre) and masks/ (255 = dynamic).
    - rgb.txt, depth.txt, mask.txt, associations.txt, groundtruth.txt and intrinsics.txt.
    - coverage.txt (dynamic share of the image) and movers.jsonl.
    - surface.ply (the static surface) and surface_observed.ply (the part that the camera saw).

    If interrupted, the lists contain the complete frames. ``overwrite`` accepts a folder with content; ``progress``
    receives finished frames.

    Raises:
        DatasetError: The folder has content, or cannot be written.
    """
    out = Path(out)
    try:
        if out.exists() and (not out.is_dir() or (any(out.iterdir()) and not overwrite)):
            raise DatasetError(f"{out} exists and is not an empty folder; name another one or allow overwriting it")
        for name in ("rgb", "depth", "masks"):
            (out / name).mkdir(parents=True, exist_ok=True)
        _write_parameters(sequence, out)
    except OSError as error:
        raise DatasetError(f"cannot write to {out}: {error}") from error
    done = 0
    pending: list[Future[None]] = []
    shares: list[float] = []
    try:
        with ThreadPoolExecutor(2) as pool, (out / "movers.jsonl").open("w", encoding="utf-8") as movers:
            for index in range(len(sequence)):
                frame, mask = sequence[index], sequence.mask(index)
                name = f"{frame.timestamp:.6f}.png"
                pending.append(pool.submit(_write_image, out / "rgb" / name, frame.rgb[..., ::-1]))
                pending.append(pool.submit(_write_image, out / "depth" / name, _quantised(sequence, frame.depth)))
                pending.append(pool.submit(_write_image, out / "masks" / name, mask.astype(np.uint8) * 255))
                movers.write(_movers_line(sequence, index) + "\n")
                shares.append(float(mask.mean()))
                while len(pending) > 3 * PENDING:
                    pending.pop(0).result()
                done = index + 1
                if progress is not None:
                    progress(done)
            for job in pending:
                job.result()
    except OSError as error:
        raise DatasetError(f"cannot write to {out}: {error}") from error
    finally:
        _write_lists(sequence, out, shares[:done])
    if surface:
        sequence.surface().save(out / "surface.ply")
        sequence.surface(observed=True).save(out / "surface_observed.ply")
    return out


def _quantised(sequence: SyntheticSequence, depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    units = np.rint(depth * np.float32(sequence.camera.depth_scale))
    return np.where(units > 65535, 0, units).astype(np.uint16)


def _write_image(path: Path, image: NDArray) -> None:
    options = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
    path.write_bytes(cv2.imencode(".png", image, options)[1].tobytes())  # OpenCV's files need an ASCII path on Windows


def _movers_line(sequence: SyntheticSequence, index: int) -> str:
    states = [
        {"id": state.id, "name": state.name, "moving": state.moving,
         "T_world_mover": np.round(state.T_world_mover, 6).tolist(), "velocity": np.round(state.velocity, 5).tolist(),
         "speed": round(float(np.linalg.norm(state.velocity)), 5)}
        for state in sequence.movers(index)
    ]  # fmt: skip
    return json.dumps({"frame": index, "timestamp": float(sequence.timestamps[index]), "movers": states})


def _write_parameters(sequence: SyntheticSequence, out: Path) -> None:
    camera = sequence.camera
    keys = ("fx", "fy", "cx", "cy", "width", "height", "depth_scale")
    (out / "intrinsics.txt").write_text("".join(f"{key} {getattr(camera, key)}\n" for key in keys), encoding="utf-8")
    sensor = asdict(sequence.sensor_model) if sequence.sensor_model else None
    made = {"made_by": f"dudmap {__version__}", "name": sequence.name}
    parameters = {**made, **sequence.parameters, "camera": asdict(camera), "sensor": sensor}
    (out / "scene.json").write_text(json.dumps(parameters, indent=2) + "\n", encoding="utf-8")
    truth = json.dumps(sequence.sensor_truth(), indent=2)
    (out / "sensor_truth.json").write_text(truth + "\n", encoding="utf-8")


def _write_lists(sequence: SyntheticSequence, out: Path, shares: list[float]) -> None:
    stamps = [f"{stamp:.6f}" for stamp in sequence.timestamps[: len(shares)]]
    lists = {
        "rgb.txt": [f"{t} rgb/{t}.png" for t in stamps],
        "depth.txt": [f"{t} depth/{t}.png" for t in stamps],
        "mask.txt": [f"{t} masks/{t}.png" for t in stamps],
        "associations.txt": [f"{t} rgb/{t}.png {t} depth/{t}.png" for t in stamps],
        "coverage.txt": [f"{t} {share:.5f}" for t, share in zip(stamps, shares, strict=True)],
    }
    for name, lines in lists.items():
        (out / name).write_text("\n".join([f"# synthetic, {sequence.name}", *lines]) + "\n", encoding="utf-8")
    sequence.ground_truth.save(out / "groundtruth.txt")
