"""Synthetic recording: rendered frames with true poses, masks, movers and surface."""

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh import Mesh, with_faces
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import FrameError
from dudmap.lab.synthetic.color_camera import ColorCamera, DepthFaults, compressed, exposure_gains, white_balance
from dudmap.lab.synthetic.faults import SensorFaults
from dudmap.lab.synthetic.movers import MOVING_SPEED, SyntheticMover, placed
from dudmap.lab.synthetic.render import Renderer, Rendering
from dudmap.lab.synthetic.scene import Scene
from dudmap.lab.synthetic.sensors import Sensor, SensorModel, TimeOfFlightModel
from dudmap.lab.synthetic.surface import count_views, tessellate

NEAREST, FARTHEST = 0.3, 6.0
"""Range of an ideal sensor, metres."""
DEFAULT_CAMERA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480, depth_scale=5000.0)


class MoverState(NamedTuple):
    """A mover in one frame: identity (1, ...), pose (4, 4), velocity (3,) in m/s (world frame), kind, and whether it
    counts as ``moving``."""

    id: int
    T_world_mover: NDArray[np.float64]
    velocity: NDArray[np.float64]
    name: str
    moving: bool


class SyntheticSequence:
    """Sequence whose frames are rendered on access; ``sequence[i]`` always returns the same frame.

    Attributes:
        faults: Errors that the sensor's files do not state.
        timestamps: (N,) seconds.
    """

    calibration = None

    def __init__(
        self,
        scene: Scene,
        movers: list[SyntheticMover],
        ground_truth: Trajectory,
        camera: Camera,
        *,
        noise: str,
        seed: int,
        fps: float,
        motion_blur: float = 0.0,
        exposure_change: float = 0.0,
        faults: SensorFaults | None = None,
        parameters: dict[str, object] | None = None,
    ) -> None:
        self.scene, self.camera, self.ground_truth = scene, camera, ground_truth
        self.faults = faults or SensorFaults()
        self.timestamps = ground_truth.timestamps
        self.parameters = dict(parameters or {})
        self.name = "-".join([scene.name, *dict.fromkeys(mover.name for mover in movers)])
        self._movers, self._noise, self._seed, self._fps = movers, noise, seed, fps
        self._motion_blur, self._exposure_change = motion_blur, exposure_change
        self._sensor = Sensor(noise, seed)
        self._depth_faults = DepthFaults(self.faults, camera, seed)
        self._color_camera = ColorCamera(self.faults, camera, motion_blur / fps, 1 / fps)
        owned = [p for mover in movers for p in mover.primitives]
        self._owner = np.repeat(np.arange(len(movers)), [len(mover.primitives) for mover in movers])
        self.renderer = Renderer(scene, scene.primitives + owned)
        self._kept: OrderedDict[int, tuple[Frame, NDArray[np.bool_]]] = OrderedDict()

    def __len__(self) -> int:
        return len(self.timestamps)

    def __iter__(self) -> Iterator[Frame]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> Frame:
        """Frame number ``index`` (negative counts from the end).

        Raises:
            FrameError: There is no such frame.
        """
        return self._both(index)[0]

    def mask(self, index: int) -> NDArray[np.bool_]:
        """True dynamic mask (H, W): people, and movers one of whose points exceeds 0.01 m/s over the frame's interval,
        as a whole."""
        index = self._number(index)
        if index in self._kept:
            return self._kept[index][1].copy()
        return self._mask_of(self._render(index, with_color=False), index)

    def exact(self, index: int) -> Rendering:
        """Ideal depth and primitive of a frame, and the light on the colour camera (its place, time and lens; no noise,
        exposure, white balance, vignetting, compression)."""
        return self._render(self._number(index), with_color=True)

    def exact_depth(self, index: int) -> NDArray[np.float32]:
        """Ideal depth (H, W), metres, 0 = none."""
        return self._render(self._number(index), with_color=False).depth

    @property
    def color_camera(self) -> Camera:
        """True intrinsics of the colour camera."""
        return self._color_camera.camera

    @property
    def sensor_model(self) -> SensorModel | TimeOfFlightModel | None:
        """Noise model, None if ideal."""
        return self._sensor.model

    def movers(self, index: int) -> list[MoverState]:
        """Movers in a frame, visible or not."""
        index = self._number(index)
        t = float(self.timestamps[index])
        return [
            MoverState(number, mover.reference(t), mover.velocity(t), mover.name, self._moves(mover, t))
            for number, mover in enumerate(self._movers, start=1)
            if mover.present(t)
        ]

    def static_twin(self) -> "SyntheticSequence":
        """Recording with the same path and noise, without movers."""
        return self._like(self.scene, [], self.parameters | {"movers": []})

    def in_scene(self, scene: Scene) -> "SyntheticSequence":
        """Recording with the same path, movers and noise in another scene."""
        return self._like(scene, self._movers, self.parameters)

    def _like(self, scene: Scene, movers: list[SyntheticMover], parameters: dict[str, object]) -> "SyntheticSequence":
        return SyntheticSequence(
            scene, movers, self.ground_truth, self.camera,
            noise=self._noise, seed=self._seed, fps=self._fps, motion_blur=self._motion_blur,
            exposure_change=self._exposure_change, faults=self.faults, parameters=parameters,
        )  # fmt: skip

    def mover_numbers(self, index: int) -> NDArray[np.int16]:
        """Identity (H, W) of the visible mover, at rest too, 0 = none."""
        numbers = np.arange(1, len(self._movers) + 1, dtype=np.int16)
        return self._by_pixel(numbers, self._render(self._number(index), with_color=False))

    def surface(self, observed: bool = False) -> Mesh:
        """True static surface at the end of the sequence, world frame, with resting movers, without triangles inside
        solids.

        Args:
            observed: Only parts seen in three of up to 120 even frames, within the sensor's range, not at a grazing
                angle.
        """
        mesh = self._surface
        if not observed:
            return mesh
        model = self._sensor.model
        reach = (model.nearest, model.fade) if model else (NEAREST, FARTHEST)
        frames = np.unique(np.linspace(0, len(self) - 1, min(len(self), 120)).astype(int))
        shots = ((self.ground_truth.Ts_world_camera[index], self.exact_depth(index)) for index in frames)
        counts = count_views(mesh, self.camera, shots, reach, model.grazing if model else 0.1)
        enough = counts >= min(3, len(frames))
        return with_faces(mesh, np.all(enough[mesh.faces], axis=1))

    @cached_property
    def _surface(self) -> Mesh:
        end = float(self.timestamps[-1])
        resting = [
            primitive.moved(T)
            for mover in self._movers
            if mover.settles and mover.present(end) and mover.top_speed(end - 0.5, 1.0) < MOVING_SPEED
            for primitive, T in zip(mover.primitives, mover.parts(end), strict=True)
        ]
        return tessellate(self.scene.primitives + resting, self.scene.detail, self.scene.extent, self.renderer.atlas)

    def _number(self, index: int) -> int:
        number = index + len(self) if index < 0 else index
        if not 0 <= number < len(self):
            raise FrameError(f"frame {index} does not exist; the sequence has {len(self)} frames")
        return number

    def _moves(self, mover: SyntheticMover, t: float) -> bool:
        return not mover.settles or mover.top_speed(t, 1.0 / self._fps) > MOVING_SPEED

    def _both(self, index: int) -> tuple[Frame, NDArray[np.bool_]]:
        index = self._number(index)
        if index not in self._kept:
            rendering = self._render(index, with_color=True)
            depth, color = self._sensor.measure(self._with_errors(rendering, index), self.camera.fx, index)
            if self.faults.jpeg_quality:
                color = compressed(color, self.faults.jpeg_quality)
            frame = Frame(float(self.timestamps[index]), depth, color)
            self._kept[index] = (frame, self._mask_of(rendering, index))
            while len(self._kept) > 2:
                self._kept.popitem(last=False)
        frame, mask = self._kept[index]
        return replace(frame, depth=frame.depth.copy(), color=frame.rgb.copy()), mask

    def _with_errors(self, rendering: Rendering, index: int) -> Rendering:
        assert rendering.color is not None
        gain = float(self.exposure_gains[index])
        color = self._color_camera.exposed(rendering.color, float(self.timestamps[index]), gain)
        depth = self._depth_faults.apply(rendering.depth, index) if self._depth_faults else rendering.depth
        return replace(rendering, depth=depth, color=color)

    @cached_property
    def exposure_gains(self) -> NDArray[np.float64]:
        """Factors (N,) of the automatic exposure."""
        if not self.faults.auto_exposure:
            return np.ones(len(self))
        camera = self.color_camera.resized(max(self.camera.width // 8, 16), max(self.camera.height // 8, 16))
        levels = np.array([self._seen_by_color_camera(float(t), camera).mean() for t in self.timestamps])
        return exposure_gains(levels, self.timestamps, self.faults.auto_exposure)

    def sensor_truth(self) -> dict[str, object]:
        """Errors that the sensor's files do not state, for a JSON file."""
        truth = self.faults.truth(self.camera)
        if self._depth_faults:
            truth |= self._depth_faults.truth()
        if self.faults.auto_exposure:
            truth["exposure_gains"] = self.exposure_gains.tolist()
        if self.faults.white_balance_drift:
            truth["white_balance_rgb"] = [white_balance(self.faults, float(t)).tolist() for t in self.timestamps]
        return truth

    def _mask_of(self, rendering: Rendering, index: int) -> NDArray[np.bool_]:
        t = float(self.timestamps[index])
        moving = np.array([mover.present(t) and self._moves(mover, t) for mover in self._movers], dtype=bool)
        return self._by_pixel(moving, rendering)

    def _by_pixel(self, of_movers: NDArray[Any], rendering: Rendering) -> NDArray[Any]:
        still = np.zeros(len(self.scene.primitives), dtype=of_movers.dtype)
        return np.concatenate([still, of_movers[self._owner], still[:1]])[rendering.primitive]

    def _render(self, index: int, with_color: bool) -> Rendering:
        t = float(self.timestamps[index])
        sharp = self._render_at(t, self.ground_truth.Ts_world_camera[index], self.camera, with_color)
        if not with_color:
            return sharp
        if self.faults.color_is_separate:
            return replace(sharp, color=self._color_camera.view(t, self._seen_by_color_camera))
        if self._motion_blur <= 0 or sharp.color is None:
            return sharp
        color = np.zeros_like(sharp.color)
        shares = (np.arange(5) - 2) / 5 * self._motion_blur  # of the time between two frames
        for share in shares:
            moment = t + share / self._fps
            inside = min(max(moment, self.timestamps[0]), self.timestamps[-1])
            blurred = self._render_at(moment, self.ground_truth.interpolate(inside), self.camera, True)
            assert blurred.color is not None
            color += blurred.color / len(shares)
        return replace(sharp, color=color)

    def _seen_by_color_camera(self, t: float, camera: Camera) -> NDArray[np.float32]:
        color = self._render_at(t, self._pose_at(t) @ self.faults.T_depth_color, camera, True).color
        assert color is not None
        return color

    def _pose_at(self, t: float) -> NDArray[np.float64]:
        stamps, Ts = self.timestamps, self.ground_truth.Ts_world_camera
        if stamps[0] <= t <= stamps[-1]:
            return self.ground_truth.interpolate(t)
        if len(stamps) == 1:
            return Ts[0]
        at = 0 if t < stamps[0] else len(stamps) - 2
        return se3.interpolate(Ts[at], Ts[at + 1], (t - stamps[at]) / (stamps[at + 1] - stamps[at]))

    def _render_at(self, t: float, T_world_camera: NDArray[np.float64], camera: Camera, with_color: bool) -> Rendering:
        Ts, present = placed(self._movers, t)
        gain = 1.0 + self._exposure_change * np.sin(2 * np.pi * t / 2.7)
        return self.renderer.render(camera, T_world_camera, Ts, present, with_color=with_color, gain=gain)
