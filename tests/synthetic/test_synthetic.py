import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from dudmap import open_sequence
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError, DatasetError, FrameError
from dudmap.lab import synthetic
from dudmap.lab.synthetic import scene as parts
from dudmap.lab.synthetic.folder import write_folder
from dudmap.lab.synthetic.render import Renderer
from dudmap.lab.synthetic.rooms import SCENES, build_scene
from dudmap.lab.synthetic.sensors import SENSORS
from dudmap.lab.synthetic.surface import tessellate

SMALL = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
TINY = Camera(52.5, 52.5, 31.5, 23.5, 64, 48)


def small(**arguments):
    return synthetic.sequence(**({"scene": "box", "camera": SMALL, "frames": 12, "noise": "none"} | arguments))


def signed_distance(primitive, points):
    """Distance to a primitive, written independently of the package (textbook formulas, local frame)."""
    local = np.einsum(
        "ij,nj->ni", np.linalg.inv(primitive.T_body_primitive), np.c_[points, np.ones(len(points))]
    )[:, :3]  # fmt: skip
    x, y, z = np.abs(local.T)
    a, b, c = primitive.half
    if primitive.kind == parts.BOX:
        dx, dy, dz = x - a, y - b, z - c
        outside = np.sqrt(np.maximum(dx, 0) ** 2 + np.maximum(dy, 0) ** 2 + np.maximum(dz, 0) ** 2)
        return outside + np.minimum(np.maximum(np.maximum(dx, dy), dz), 0)
    if primitive.kind == parts.CAPSULE:
        return np.sqrt(x**2 + y**2 + np.maximum(z - c, 0) ** 2) - a
    if primitive.kind == parts.CYLINDER:
        side, cap = np.hypot(x, y) - a, z - c
        return np.where((side > 0) & (cap > 0), np.hypot(side, cap), np.maximum(side, cap))
    if primitive.kind == parts.TORUS:
        return np.hypot(np.hypot(x, y) - a, z) - c
    return (np.sqrt((x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2) - 1) * min(a, b, c)  # a lower bound is enough here


def sphere_traced(primitives, camera, T_world_camera):
    """Depth (H, W) by sphere tracing all primitives from every pixel in plain NumPy."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    rays = rays.reshape(-1, 3)
    lengths = np.linalg.norm(rays, axis=1)
    directions = rays @ T_world_camera[:3, :3].T
    t = np.full(len(rays), 0.02)
    for _ in range(400):
        points = T_world_camera[:3, 3] + t[:, None] * directions
        step = np.min([signed_distance(p, points) for p in primitives], axis=0)
        t = np.where(t < 50, t + step / lengths, t)
    return np.where((step < 1e-7) & (t < 50), t, 0.0).reshape(u.shape)


def every_kind():
    material = parts.Material("checks")
    return [
        parts.box((0, 0, -0.05), (6, 8, 0.1), material),
        parts.box((0.5, 2.2, 0.5), (0.5, 0.4, 0.6), material, yaw=30, pitch=20),
        parts.ellipsoid((-0.6, 2.0, 0.5), (0.3, 0.2, 0.4), material, yaw=40),
        parts.capsule((-0.2, 1.6, 0.2), (0.3, 1.9, 0.9), 0.08, material),
        parts.cylinder((1.0, 1.8, 0.0), (0.9, 1.7, 0.7), 0.15, material),
        parts.torus((0.0, 2.4, 1.0), (0.3, -1.0, 0.4), 0.25, 0.06, material),
        parts.capsule((-1.5, 2.5, 0.3), (1.5, 2.7, 1.3), 0.003, material),
    ]


def test_depth_agrees_with_sphere_tracing_in_numpy():
    primitives = every_kind()
    world = build_scene("box")
    renderer = Renderer(world, primitives)
    renderer._static = np.array([p.T_body_primitive for p in primitives])
    T = parts.look_at((0.1, 0.0, 1.2), (0.0, 2.0, 0.5), roll=7)
    nothing = np.empty((0, 4, 4)), np.empty(0, dtype=bool)
    depth = renderer.render(TINY, T, *nothing, with_color=False).depth
    expected = sphere_traced(primitives, TINY, T)
    both = (depth > 0) & (expected > 0)
    assert both.mean() > 0.6
    assert ((depth > 0) != (expected > 0)).mean() < 0.002  # only rays that touch a rim
    error = np.abs(depth - expected)[both]
    assert (error < 1e-4).mean() > 0.995
    assert np.median(error) < 2e-6


@pytest.mark.parametrize("scene", list(SCENES))
def test_depth_of_every_scene_lies_on_its_surfaces(scene):
    recording = synthetic.sequence(scene=scene, camera=TINY, frames=3, noise="none", movers=())
    depth = recording[1].depth
    T = recording.ground_truth.Ts_world_camera[1]
    points = TINY.backproject(depth).reshape(-1, 3)[depth.ravel() > 0].astype(float) @ T[:3, :3].T + T[:3, 3]
    distance = np.min([signed_distance(p, points) for p in recording.scene.primitives], axis=0)
    assert len(points) > 0.6 * depth.size
    assert np.abs(distance).max() < 1e-5
    assert recording.scene.clearance(recording.ground_truth.Ts_world_camera[:, :3, 3]).min() > 0.05


def test_a_picture_is_not_mirrored_on_any_side_of_a_box():
    """The same picture, which is its mirror image nowhere, on all four sides and in the colours of the true surface."""
    picture = parts.Material("poster", (1, 1), (0.5, 0.5), variation=0, faces=False)
    scene = replace(
        build_scene("box"), primitives=[parts.box((0, 0, 0), (1, 1, 1), picture)], lights=(parts.Light((0, 0, 9), 0),)
    )
    renderer, nothing = Renderer(scene, scene.primitives), (np.zeros((0, 4, 4)), np.zeros(0, bool))
    eyes = ((0, -2.3, 0), (2.3, 0, 0), (0, 2.3, 0), (-2.3, 0, 0))
    front, *others = (renderer.render(TINY, parts.look_at(eye, (0, 0, 0)), *nothing).color for eye in eyes)
    assert np.abs(front - front[:, ::-1]).max() > 50
    for color in others:
        np.testing.assert_allclose(color, front, atol=1)
    surface = tessellate(scene.primitives, 0.02, ((-1, -1, -1), (1, 1, 1)), renderer.atlas)
    colors = []
    for axis, side in ((1, -1), (0, 1), (1, 1), (0, -1)):
        on = surface.normals[:, axis] * side > 0.9
        right = surface.vertices[on, 1 - axis] * (side if axis == 0 else -side)
        order = np.lexsort((surface.vertices[on, 2].round(4), right.round(4)))
        colors.append(surface.colors[on][order].astype(int))
    assert np.median(np.abs(np.array(colors) - colors[0]), axis=(1, 2)).max() <= 1
    assert (np.abs(np.array(colors) - colors[0]) > 8).mean() < 0.03  # a texel's border may fall to either side


def test_points_moved_by_the_true_poses_land_on_the_same_surface():
    recording = small(camera_path="orbit", frames=30, movers=())
    first, last = recording[0], recording[29]
    T = se3.inverse(recording.ground_truth.Ts_world_camera[29]) @ recording.ground_truth.Ts_world_camera[0]
    points = SMALL.backproject(first.depth).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
    pixels = SMALL.project(points)
    inside = np.all((pixels > 1) & (pixels < np.array([158, 118])), axis=1)
    u, v = np.rint(pixels[inside]).astype(int).T
    gap = np.abs(last.depth[v, u] - points[inside, 2])
    assert inside.mean() > 0.7
    assert np.percentile(gap, 85) < 0.012  # rounding to a pixel on slanted walls; occlusion beyond that
    gray = recording[0].color.reshape(-1, 3)[inside].mean(axis=1), last.color[v, u].mean(axis=1)
    assert np.corrcoef(*gray)[0, 1] > 0.9


def test_mask_is_exactly_where_the_mover_changes_the_picture():
    recording = small(movers=("person",), frames=60, start_dynamic=True, camera_path="still")
    twin = recording.static_twin()
    masks = np.stack([recording.mask(k) for k in (0, 10)])
    assert masks.mean() > 0.05
    for k, mask in zip((0, 10), masks, strict=True):
        assert np.array_equal(mask, recording[k].depth != twin[k].depth)
        assert np.array_equal(mask, recording.mover_numbers(k) == 1)


def test_sensor_noise_is_the_same_with_and_without_movers():
    recording = small(movers=("person",), start_dynamic=True, noise="kinect", frames=3)
    twin, mask = recording.static_twin(), recording.mask(1)
    far = ~np.pad(mask, 30)[30:-30, 30:-30]
    for shift in range(-30, 31):
        far &= ~np.roll(mask, shift, axis=1)
    for shift in (-1, 1):  # colours at a border are averaged over both sides
        far &= ~np.roll(mask, shift, axis=0)
    assert far.mean() > 0.2
    assert np.array_equal(recording[1].color[~mask & far], twin[1].color[~mask & far])
    assert (recording[1].depth != twin[1].depth)[far].mean() < 0.01


def test_frames_depend_on_seed_and_index_only():
    recording, again, other = (small(noise="kinect", seed=seed) for seed in (1, 1, 2))
    later = recording[7]
    assert np.array_equal(later.depth, again[7].depth)
    assert np.array_equal(later.color, again[7].color)
    for index in (1, 2, 3):
        recording[index]
    assert np.array_equal(recording[7].depth, later.depth)
    assert np.array_equal(recording[-5].color, later.color)
    assert not np.array_equal(other[7].depth, later.depth)


@pytest.mark.parametrize("noise", ["kinect", "realsense", "d435"])
def test_depth_noise_grows_with_the_square_of_depth(noise):
    model = SENSORS[noise]
    camera = Camera(525, 525, 319.5, 239.5, 640, 480)
    wall = parts.Material("plain")
    for distance in (1.5, 3.0):
        slanted = parts.box((0, distance + 0.5, 0), (20, 1.0, 20), wall, yaw=3)  # slanted: all disparities occur
        renderer = Renderer(build_scene("box"), [slanted])
        renderer._static = slanted.T_body_primitive[None]
        nothing = np.empty((0, 4, 4)), np.empty(0, dtype=bool)
        rendering = renderer.render(camera, parts.look_at((0, 0, 0), (0, 1, 0)), *nothing)
        depth, _ = synthetic.recording.Sensor(noise, 0).measure(rendering, camera.fx, 0)
        exact = rendering.depth
        seen = (depth > 0) & (np.abs(np.arange(640) - 320) < 200)
        relative = ((depth - exact) / exact**2)[seen]
        assert seen[:, 120:520].mean() > 0.98
        assert relative.std() == pytest.approx(model.depth_noise, rel=0.12)
        assert abs(relative.mean()) < 0.15 * model.depth_noise
        error = np.where(seen, depth - exact, 0)
        assert (error[:, 1:] * error[:, :-1]).mean() > 0.3 * (error**2).mean()  # errors of neighbours are alike


def test_kinect_depth_comes_in_steps_and_with_holes():
    recording = small(
        noise="kinect", movers=("person",), start_dynamic=True, camera=Camera(525, 525, 319.5, 239.5, 640, 480)
    )
    depth, exact = recording[1].depth, recording.exact_depth(1)
    disparity = 525 * 0.075 / depth[depth > 0].astype(float) * 8
    assert np.abs(disparity - np.rint(disparity)).max() < 1e-2
    assert depth[depth > 0].min() >= 0.5
    mask = recording.mask(1)
    holes = (depth == 0) & (exact > 0.5) & (exact < 4.5)
    rim = np.zeros_like(mask)
    for shift in range(1, 12):  # the projector stands to the right: its shadow lies left of near things
        rim |= np.roll(mask, -shift, axis=1) & ~mask
    assert holes[rim].mean() > 0.3
    assert 0.005 < holes.mean() < 0.2


def test_a_box_put_down_is_static_and_part_of_the_surface():
    recording = small(movers=("carried_box",), frames=200, camera_path="still")
    states = [{s.name: s.moving for s in recording.movers(k)} for k in range(200)]
    assert states[20]["carried_box"]
    assert not states[-1]["carried_box"]
    assert all(state["person"] for state in states if "person" in state)
    box = recording.scene.rest[:3, 3]

    def near(mesh):
        height = mesh.vertices[:, 2]
        return (np.linalg.norm(mesh.vertices[:, :2] - box[:2], axis=1) < 0.1) & (height > 0.1) & (height < 1)

    assert near(recording.surface()).any()
    assert not near(recording.static_twin().surface()).any()
    shown = recording.mover_numbers(199) == 2
    assert shown.any()
    assert not recording.mask(199)[shown].any()


def test_a_removed_box_is_not_part_of_the_surface():
    recording = small(movers=("removed_box",), frames=220, camera_path="still")
    assert recording.mover_numbers(0).max() == 2
    assert not recording.mask(0).any()
    names = {s.name for s in recording.movers(219)}
    assert "removed_box" not in names
    twin = recording.static_twin()
    assert len(recording.surface().vertices) == len(twin.surface().vertices)


def test_surface_lies_on_the_primitives_and_its_seen_part_in_front_of_the_camera():
    recording = small(movers=(), frames=6)
    mesh, seen = recording.surface(), recording.surface(observed=True)
    distance = np.min([signed_distance(p, mesh.vertices.astype(float)) for p in recording.scene.primitives], axis=0)
    assert np.abs(distance).max() < 1e-5
    corners = mesh.vertices[mesh.faces].astype(float)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normal * mesh.normals[mesh.faces[:, 0]]).sum(axis=1) > 0).all()
    inner = 2 * 9 + 4 * 3 * 2.2  # floor, ceiling, walls of the empty room
    things = 0.5 * 0.6 * 4 + 4 * np.pi * 0.3**2
    assert mesh.area() == pytest.approx(inner + things, rel=0.02)
    assert 0.1 < seen.area() / mesh.area() < 0.6
    T = se3.inverse(recording.ground_truth.Ts_world_camera[3])
    points = seen.vertices @ T[:3, :3].T + T[:3, 3]
    assert (points[:, 2] > 0.2).all()


def test_velocity_is_the_motion_of_the_mover():
    recording = small(movers=("ball",), start_dynamic=True, speed=0.4, frames=10)
    before, now, after = (recording.movers(k)[0] for k in (4, 5, 6))
    moved = (after.T_world_mover - before.T_world_mover)[:3, 3] / (2 / 30)
    assert np.linalg.norm(now.velocity) == pytest.approx(0.4, rel=0.02)
    assert np.allclose(now.velocity, moved, atol=0.01)


@pytest.mark.parametrize(("share", "speed"), [(0.1, None), (0.5, 0.05), (0.9, 3.0)])
def test_coverage_is_met(share, speed):
    recording = synthetic.sequence(camera=TINY, frames=120, coverage=share, speed=speed, noise="none")
    assert not recording.mask(10).any()
    assert np.mean([recording.mask(k).mean() for k in range(85, 120, 3)]) == pytest.approx(share, abs=0.05)
    speeds = [np.linalg.norm(state.velocity) for state in recording.movers(110)]
    assert np.allclose(speeds, speed or 1.0, rtol=0.02)


@pytest.mark.parametrize(("path", "speed", "turn"), [("handheld", 0.2, 10), ("slow", 0.06, 3), ("fast", 0.6, 45)])
def test_hand_held_paths_have_their_speed(path, speed, turn):
    recording = synthetic.sequence(camera=TINY, camera_path=path, frames=300, movers=())
    Ts = recording.ground_truth.Ts_world_camera
    steps = [se3.inverse(a) @ b for a, b in pairwise(Ts)]
    assert 30 * np.mean([np.linalg.norm(T[:3, 3]) for T in steps]) == pytest.approx(speed, rel=0.5)
    assert 30 * np.degrees(np.mean([se3.rotation_angle(T) for T in steps])) == pytest.approx(turn, rel=0.6)


def test_recorded_path_keeps_its_shape(tmp_path):
    stamps = np.arange(0, 3, 0.02) + 1341846313.6
    Ts = np.stack([se3.exp(np.array([0.3 * np.sin(t), 0.1 * t, 0, 0, 0.2 * t, 0.1])) for t in stamps - stamps[0]])
    Trajectory(stamps, se3.exp(np.array([5, 6, 7, 2.0, 0.3, 0.1])) @ Ts).save(tmp_path / "path.txt")
    recording = synthetic.sequence(camera=TINY, camera_path=tmp_path / "path.txt", frames=60, fps=25, movers=())
    made = recording.ground_truth.Ts_world_camera
    for i, j in ((0, 20), (10, 50)):
        expected = se3.inverse(Ts[2 * i]) @ Ts[2 * j]
        assert np.allclose(se3.inverse(made[i]) @ made[j], expected, atol=1e-6)
    assert recording.scene.clearance(made[:, :3, 3]).min() > 0.2
    with pytest.raises(ConfigError, match=r"lasts 2\.98 s.*fewer frames"):
        synthetic.sequence(camera_path=tmp_path / "path.txt", frames=120)


def test_kidnapped_camera_jumps_and_comes_back_while_covered():
    recording = synthetic.sequence(situation="kidnapped", frames=120, camera=TINY, noise="kinect")
    jumps = np.array(
        [se3.rotation_angle(se3.inverse(a) @ b) for a, b in pairwise(recording.ground_truth.Ts_world_camera)]
    )
    where = np.flatnonzero(jumps > 1.0)
    assert len(where) == 2
    for index in where:
        assert recording[int(index)].depth.max() == 0
        assert recording.mask(int(index)).all()
    assert recording[60].depth.max() > 0
    assert not recording.mask(100).any()


@pytest.mark.parametrize("name", ["people_at_start", "follow", "blocked", "stops", "starts", "put_down", "taken_away"])
def test_situations(name):
    recording = synthetic.sequence(situation=name, frames=150, camera=TINY, noise="none")
    shares = np.array([recording.mask(k).mean() for k in range(0, 150, 5)])
    assert shares.max() > 0.02
    if name in ("people_at_start", "follow"):
        assert shares[0] > 0.02
    if name == "follow":
        assert shares.min() > 0.02
    if name == "blocked":
        assert shares.max() == 1.0
    if name in ("stops", "starts"):
        shown = recording.mover_numbers(149 if name == "stops" else 0) == 1
        assert shown.mean() > 0.01
        assert not recording.mask(149 if name == "stops" else 0)[shown].any()


def test_motion_blur_and_exposure_change_touch_colour_only():
    sharp, blurred = small(camera_path="fast"), small(camera_path="fast", motion_blur=0.8)
    dark = small(camera_path="fast", exposure_change=0.4)
    assert np.array_equal(sharp[5].depth, blurred[5].depth)
    detail = [np.abs(np.diff(s[5].color.astype(float), axis=1)).mean() for s in (sharp, blurred)]
    assert detail[1] < 0.97 * detail[0]
    means = np.array([dark[k].color.mean() / sharp[k].color.mean() for k in range(12)])
    assert np.ptp(means) > 0.1


def test_folder_opens_again_as_the_same_recording(tmp_path):
    recording = small(movers=("person",), start_dynamic=True, noise="kinect", frames=4)
    write_folder(recording, tmp_path / "made")
    opened = open_sequence(tmp_path / "made")
    assert opened.camera == SMALL
    assert len(opened) == 4
    for k in range(4):
        a, b = recording[k], opened[k]
        assert a.timestamp == b.timestamp
        assert np.array_equal(a.color, b.color)
        assert np.abs(a.depth - b.depth).max() < 0.5 / SMALL.depth_scale + 1e-6
        assert np.array_equal(recording.mask(k), opened.mask(k))
    assert np.allclose(opened.ground_truth.Ts_world_camera, recording.ground_truth.Ts_world_camera, atol=1e-8)
    lines = [json.loads(line) for line in (tmp_path / "made" / "movers.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines] == [0, 1, 2, 3]
    assert lines[2]["movers"][0]["name"] == "person"
    assert np.allclose(lines[2]["movers"][0]["T_world_mover"], recording.movers(2)[0].T_world_mover, atol=1e-5)
    assert json.loads((tmp_path / "made" / "scene.json").read_text())["seed"] == 0
    assert len(Mesh.load(tmp_path / "made" / "surface.ply").faces) == len(recording.surface().faces)
    with pytest.raises(DatasetError, match="not an empty folder"):
        write_folder(recording, tmp_path / "made")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"scene": "palace"}, "unknown scene 'palace'; known scenes: room, corridor"),
        ({"movers": ("dog",)}, "unknown mover 'dog'; known movers: person"),
        ({"noise": "lidar"}, "unknown noise model 'lidar'; known noise models: kinect, realsense, none"),
        ({"camera_path": "zigzag"}, "camera path 'zigzag' is neither a trajectory file nor one of handheld"),
        ({"situation": "fog"}, "unknown situation 'fog'; known situations: people_at_start"),
        ({"coverage": 1.5}, "coverage is 1.5"),
        ({"coverage": 0.8, "scene": "desk"}, "the densest crowd in scene 'desk' covers"),
        ({"coverage": 0.5, "movers": ("ball",)}, "coverage stands for people"),
        ({"frames": 0}, "frames is 0"),
        ({"fps": 0.0}, "fps is 0.0"),
        ({"speed": -1.0}, "speed is -1.0"),
        ({"camera_path": "follow", "movers": ()}, "needs a mover to follow"),
    ],
)
def test_bad_arguments_are_one_sentence(arguments, sentence):
    with pytest.raises(ConfigError) as error:
        synthetic.sequence(**arguments)
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)


def test_frames_beyond_the_end():
    with pytest.raises(FrameError, match="the sequence has 12 frames"):
        small()[12]


def test_command_line(tmp_path):
    from typer.testing import CliRunner

    from dudmap.cli import application_of

    arguments = [
        str(tmp_path / "out"),
        "--scene",
        "box",
        "--size",
        "64x48",
        "--max-frames",
        "2",
        "--movers",
        "ball,person",
    ]
    result = CliRunner().invoke(application_of("synth"), [*arguments, "--quiet"])
    assert result.exit_code == 0, result.output
    assert len(open_sequence(tmp_path / "out")) == 2
    assert json.loads((tmp_path / "out" / "scene.json").read_text())["movers"] == ["ball", "person"]
    wrong = CliRunner().invoke(application_of("synth"), [*arguments[:1], "--size", "big"])
    assert isinstance(wrong.exception, ConfigError)
