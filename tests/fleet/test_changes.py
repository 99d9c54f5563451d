"""Changes between two visits: rendered worlds with exact truth, from their true poses."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import KDTree
from typer.testing import CliRunner

from dudmap.cli import app
from dudmap.core.geometry import se3
from dudmap.core.places.saved_map import SavedMap
from dudmap.errors import ConfigError, DudmapError, MapError
from dudmap.fleet import change_benchmark
from dudmap.fleet.change_benchmark import draw_pair, figures, score_pair
from dudmap.fleet.change_colors import recolored_pieces
from dudmap.fleet.change_evidence import BEHIND, CONFIRMED, DENIED, Visit
from dudmap.fleet.change_motion import Body, motion_between
from dudmap.fleet.change_objects import Piece, is_hidden_between
from dudmap.fleet.change_watch import WATCH_FILE, ChangeWatch
from dudmap.fleet.changes import find_changes, vertical
from dudmap.fleet.diff import diff_runs, summary
from dudmap.lab.synthetic.folder import write_folder
from dudmap.lab.synthetic.inserted import WithThing
from dudmap.lab.synthetic.scene import Material, box, pose
from dudmap.lab.synthetic.visits import parsed_changes, visits
from rendered_places import CAMERA, true_map

MIN_SIZE = 0.12


class Pair:
    """Two rendered visits, their maps from true poses, and what changed."""

    def __init__(self, changes, seed, without="", **options):
        self.recordings, self.truth = visits(
            parsed_changes(changes), seed=seed, camera=CAMERA, frames=30, fps=8.0, **options
        )
        self.truth = [change for change in self.truth if change.thing != without]  # hidden by the table
        self.maps = [true_map(recording, voxel_size=0.02, every=1) for recording in self.recordings]
        self.visits = (
            Visit.of(self.maps[0].saved, np.eye(4)),
            Visit.of(self.maps[1].saved, self.maps[0].T_world_other(self.maps[1])),
        )
        self.changes, self.found = find_changes(*self.visits, MIN_SIZE)
        self.score = score_pair(self.changes, self.truth, self.maps[0].T_scene_world)

    def save(self, folder):
        for name, made in zip(("before", "after"), self.maps, strict=True):
            (folder / name).mkdir(parents=True)
            made.saved.volume.save(folder / name / "map.npz")
            made.saved.save_keyframes(folder / name / "keyframes.npz")
        return folder / "before", folder / "after"


@pytest.fixture(scope="module")
def changed():
    return Pair("box:moved,ball:appeared,bin:disappeared", 6, size=0.35, without="ball")


@pytest.fixture(scope="module")
def unchanged():
    return Pair("none", 3)


@pytest.fixture(scope="module")
def runs(changed, tmp_path_factory):
    return changed.save(tmp_path_factory.mktemp("runs"))


def test_each_thing_is_found_with_its_kind(changed):
    assert [thing["kind"] for thing in changed.score["things"]] == ["moved", "disappeared"]
    assert [thing["found"] for thing in changed.score["things"]] == ["moved", "disappeared"]
    assert changed.score["false"] == []


def test_seen_the_other_way_round_what_disappeared_appears(changed):
    kinds = sorted(change.kind for change in find_changes(*changed.visits[::-1], MIN_SIZE)[0])
    assert [kind for kind in kinds if kind != "unknown"] == ["appeared", "moved"]


def test_the_motion_is_that_of_the_thing(changed):
    thing = changed.score["things"][0]
    assert thing["motion_cm"] < 1.0
    assert thing["motion_deg"] < 3.0  # a cube of 35 cm with voxels of 2 cm


def test_things_without_a_like_colour_are_not_one(changed):
    points = np.random.default_rng(6).uniform(0, 0.3, (200, 3))
    black, white = (
        Body(points, np.tile([0.0, 0, 1], (200, 1)), np.full((200, 3), grey), np.ones(200, bool), 0.01)
        for grey in (0.0, 255.0)
    )
    assert motion_between(*changed.visits, black, white, np.array([0.0, 0, 1])) is None


def test_a_motion_that_is_not_the_only_likely_one_says_so(changed):
    moved = next(change for change in changed.changes if change.kind == "moved")
    assert "ambiguous" not in moved.tree()
    assert replace(moved, motion=replace(moved.motion, ambiguous="two turns")).tree()["ambiguous"] == "two turns"


def test_a_motion_is_as_uncertain_as_it_says(changed):
    thing = changed.score["things"][0]
    assert thing["motion_cm"] < 3 * thing["sigma_cm"] < 3
    assert thing["motion_deg"] < 3 * thing["sigma_deg"] < 9
    row = next(change for change in changed.changes if change.kind == "moved").tree()
    assert (100 * row["distance_sigma"], row["turn_sigma_deg"]) == pytest.approx(
        (thing["sigma_cm"], thing["sigma_deg"]), abs=0.01
    )


def test_nothing_changed_is_found_in_an_unchanged_place(unchanged):
    assert unchanged.score == {"things": [], "false": []}


def test_evidence_is_symmetric_and_names_what_was_seen_through(changed):
    before, after = changed.found
    for true in (change for change in changed.truth if change.kind == "disappeared"):
        points = true.before - changed.maps[0].T_scene_world[:3, 3]
        points = points @ changed.maps[0].T_scene_world[:3, :3]
        gap = KDTree(points).query(before.points)[0]
        assert (before.state[gap < 0.02] == DENIED).mean() > 0.5
    assert (after.state == CONFIRMED).mean() > 0.5
    assert (before.state == BEHIND).any()  # the floor and the walls behind what appeared


def test_a_shift_within_the_noise_is_no_change(unchanged):
    visit = unchanged.visits[1]
    T = visit.T_common_map.copy()
    T[:3, 3] += 0.005
    assert not [one for one in find_changes(unchanged.visits[0], Visit.of(unchanged.maps[1].saved, T), MIN_SIZE)[0]
                if one.kind != "unknown"]  # fmt: skip


def test_a_picture_with_other_colours_is_found_and_other_light_is_not():
    pair = Pair("poster:recoloured", 3, other_light=True, paths=("slow", "slow"))
    assert [thing["found"] for thing in pair.score["things"]] == ["recoloured"]
    assert pair.score["false"] == []
    assert recolored_pieces(pair.found[1], 0.02, MIN_SIZE)
    far = replace(pair.found[1], blur=10 * pair.found[1].blur)  # pixels that are larger than what is compared
    assert recolored_pieces(far, 0.02, MIN_SIZE) == []


def test_up_is_found(changed):
    true = changed.maps[0].T_scene_world[:3, :3].T @ (0, 0, 1)
    assert vertical(changed.visits[0]) @ true > np.cos(np.radians(1.5))


# -- run folders -------------------------------------------------------------------------------------------------------


def test_diff_aligns_two_runs_and_writes_what_changed(changed, runs, tmp_path):
    tree = diff_runs(*runs, tmp_path / "out", MIN_SIZE)
    counts = {kind: number for kind, number in tree["counts"].items() if kind != "unknown"}
    assert counts["disappeared"] >= 1
    assert sum(counts.values()) >= 2
    T = changed.maps[0].T_world_other(changed.maps[1])
    off = se3.inverse(T) @ np.array(tree["T_before_after"])
    assert np.linalg.norm(off[:3, 3]) < 0.01
    assert json.loads((tmp_path / "out" / "changes.json").read_text()) == tree
    gone = next(row for row in tree["changes"] if row["kind"] == "disappeared")
    assert (tmp_path / "out" / "changes" / f"{gone['id']}.ply").stat().st_size > 1000
    assert gone["frames_before"]
    assert 0 < gone["confidence"] <= 1
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("data:image/jpeg") == 2 * sum(counts.values())  # before and after of each
    assert "{{" not in page.split("<script>")[0]
    assert f"{gone['id']}: disappeared at" in summary(tree)
    assert diff_runs(*runs, tmp_path / "out", MIN_SIZE) == tree  # the folder is replaced


def test_the_same_run_twice_did_not_change(runs):
    tree = diff_runs(runs[0], runs[0], min_size=MIN_SIZE)
    assert tree["changes"] == []
    assert summary(tree) == "both are the same run: nothing changed"


def test_bad_input_is_one_sentence(runs, tmp_path):
    with pytest.raises(MapError, match=r"holds no map\.npz and no keyframes\.npz"):
        diff_runs(tmp_path, runs[1])
    with pytest.raises(ConfigError, match=r"--min-size is 0\.01 m; expected 0\.04"):
        diff_runs(*runs, min_size=0.01)
    (tmp_path / "mine").write_text("text")
    with pytest.raises(DudmapError, match="holds no comparison"):
        diff_runs(runs[0], runs[0], tmp_path, MIN_SIZE)
    assert (tmp_path / "mine").exists()


def test_a_map_without_free_space_is_refused(runs, tmp_path):
    saved = SavedMap.load(runs[0])
    blocks = saved.volume.blocks
    blocks.free_count[:] = 0
    saved.volume.save(tmp_path / "map.npz")
    saved.save_keyframes(tmp_path / "keyframes.npz")
    with pytest.raises(MapError, match="holds no free space"):
        diff_runs(tmp_path, runs[1], min_size=MIN_SIZE)


def test_another_place_is_refused(runs, tmp_path):
    other = Pair("none", 4, scene="corridor").save(tmp_path)
    with pytest.raises(MapError, match="cannot be compared: "):
        diff_runs(runs[0], other[1], min_size=MIN_SIZE)


# -- truth, benchmark --------------------------------------------------------------------------------------------------


def test_truth_is_where_the_images_differ(changed):
    for change in changed.truth:
        assert len(change.before) + len(change.after) > 50
        copy = json.loads(json.dumps(change.tree()))
        assert copy["kind"] == change.kind
        assert np.allclose(np.reshape(copy["after"], (-1, 3)), change.after, atol=1e-4)
    moved = changed.truth[0]
    centre = moved.before.mean(axis=0)
    assert np.linalg.norm(moved.T_after_before[:3] @ np.append(centre, 1) - moved.after.mean(axis=0)) < 0.3


def test_changes_that_make_no_sense_are_refused():
    assert parsed_changes("chair:moved, none") == [("chair", "moved")]
    for text in ("chair:painted", "box:opened", "poster:moved", "chair"):
        with pytest.raises(ConfigError, match="cannot understand the change"):
            parsed_changes(text)
    with pytest.raises(ConfigError, match="unknown thing"):
        parsed_changes("sofa:moved")


def test_synth_writes_two_visits(tmp_path):
    words = ["synth", str(tmp_path / "out"), "--max-frames", "3", "--size", "80x60", "--changes", "box:moved", "--json"]
    assert CliRunner().invoke(app, words).exit_code == 2
    done = CliRunner().invoke(app, [*words, "--visits", "2"])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "out" / "visit-2" / "associations.txt").is_file()
    assert json.loads((tmp_path / "out" / "changes.json").read_text())[0]["thing"] == "box"


def test_the_score_counts_missed_false_and_wrong_kinds(changed):
    whole = figures([changed.score | {"scene": "room"}])
    assert (whole["recall_15cm"], whole["precision"], whole["kind_right"]) == (1.0, 1.0, 1.0)
    others = [change for change in changed.changes if change.kind != "moved"]
    missed = score_pair(others, changed.truth, changed.maps[0].T_scene_world)
    assert [thing["found"] for thing in missed["things"]] == [None, "disappeared"]
    assert score_pair(changed.changes, changed.truth[1:], changed.maps[0].T_scene_world)["false"] == ["moved"]
    moved = next(change for change in changed.changes if change.kind == "moved")
    apart = [replace(moved, kind="disappeared", after=None), replace(moved, kind="appeared", before=None)]
    for common, false in ((True, 1), (False, 0)):  # what showed other sides is rightly found as two
        true = replace(changed.truth[0], common=common)
        assert len(score_pair(apart, [true], changed.maps[0].T_scene_world)["false"]) == false
    wrong = [replace(change, kind="recoloured") for change in changed.changes]
    assert figures([score_pair(wrong, changed.truth, changed.maps[0].T_scene_world)])["kind_right"] == 0.0


def test_a_thing_is_put_into_a_recording_where_nothing_nearer_hides_it(unchanged):
    recording = unchanged.recordings[0]
    T, frame = recording.ground_truth.Ts_world_camera[3], recording[3]
    z = float(np.median(frame.depth[110:130, 150:170]))
    thing = box((0, 0, 0), (0.2, 0.2, 0.2), Material("books")).moved(T @ pose((0, 0, z - 0.3)))
    shown = WithThing(recording, range(2, 6), recording.ground_truth, [thing])
    changed = shown[1].depth != frame.depth
    assert changed[120, 160]
    assert 0.001 < changed.mean() < 0.3
    assert (shown[1].depth[changed & (frame.depth > 0)] < frame.depth[changed & (frame.depth > 0)] + 0.1).all()
    assert np.linalg.norm(np.median(shown.seen[0], axis=0) - (T @ (0, 0, z - 0.4, 1))[:3]) < 0.06
    behind = box((0, 0, 0), (0.2, 0.2, 0.2), Material("books")).moved(T @ pose((0, 0, z + 1)))
    hidden = WithThing(recording, range(6), recording.ground_truth, [behind])[3]
    assert (hidden.depth != frame.depth)[frame.depth > 0].sum() < 0.05 * changed.sum()


def test_parts_are_joined_only_where_no_free_space_was_seen_between(changed):
    visit = changed.visits[0]
    points = visit.mesh.vertices[changed.found[0].state == CONFIRMED].astype(float)

    def piece(at):
        near = np.linalg.norm(points - at, axis=1) < 0.08
        return Piece(np.flatnonzero(near), points[near], 0.01)

    T = visit.keyframes[0]
    seen = points[np.argsort(np.linalg.norm(points - (T @ (0, 0, 2.5, 1))[:3], axis=1))[0]]
    front = T[:3, 3] + 0.7 * (seen - T[:3, 3])
    behind = Piece(np.arange(5), seen + np.random.default_rng(1).normal(0, 0.01, (50, 3)), 0.01)
    floating = Piece(np.arange(5), front + np.random.default_rng(1).normal(0, 0.01, (50, 3)), 0.01)
    assert is_hidden_between(piece(seen), behind, visit)
    assert not is_hidden_between(floating, behind, visit)  # the camera looked through the space between


def test_given_changes_take_the_place_of_drawn_ones(tmp_path, monkeypatch):
    told = []
    row = {"scene": "desk", "seed": 1, "people": False, "things": [], "false": []}
    monkeypatch.setattr(change_benchmark, "measure_pair", lambda pair, *_: told.append(pair) or dict(row))
    words = ["benchmark", "changes", "--count", "2", "--changes", "box:moved", "--edge", "0.1", "--out", str(tmp_path)]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert [(pair["changes"], pair["size"]) for pair in told] == [([("box", "moved")], 0.1)] * 2
    assert "| unchanged_pairs | 2 |" in done.output


def test_a_fifth_of_the_pairs_has_no_change():
    pairs = [draw_pair(0, number) for number in range(200)]
    assert 25 < sum(not pair["changes"] for pair in pairs) < 55
    assert draw_pair(0, 3) == draw_pair(0, 3)


# -- live --------------------------------------------------------------------------------------------------------------


def watched(before, frames, poses, camera, out):
    told = []
    watch = ChangeWatch(before, (SimpleNamespace(event=lambda name, **row: told.append((name, row))),), MIN_SIZE)
    watch.start(SimpleNamespace(camera=camera), out, len(frames))
    for index, (frame, T) in enumerate(zip(frames, poses, strict=True)):
        result = SimpleNamespace(T_world_camera=T, submap=0, status="tracked")
        watch.frame(index, SimpleNamespace(frame=frame), result, 0.0)
    watch.finish(out)
    rows = [json.loads(line) for line in (out / WATCH_FILE).read_text().splitlines()]
    assert rows == [row for _, row in told]
    return rows


def test_what_is_gone_is_reported_while_the_run_goes_on(changed, unchanged, tmp_path):
    for pair in (changed, unchanged):
        T, recording = se3.inverse(pair.maps[0].T_scene_world), pair.recordings[1]
        frames = [recording[index] for index in range(len(recording))]
        poses = T @ recording.ground_truth.Ts_world_camera
        rows = watched(pair.maps[0].saved, frames, poses, recording.camera, tmp_path)
        assert [row["kind"] for row in rows] == ["disappeared"] * len(rows)
        true = [change for change in pair.truth if change.kind == "disappeared"]
        assert len(rows) >= len(true)
        for change in true:
            at = T[:3] @ np.append(change.before.mean(axis=0), 1)
            assert min(np.linalg.norm(np.array(row["centre"]) - at) for row in rows) < 0.25
        assert len(rows) <= 2 * len(pair.truth)


def test_run_watches_for_changes_against_the_map_of_an_earlier_visit(changed, runs, tmp_path):
    write_folder(changed.recordings[1], tmp_path / "next", surface=False)
    words = ["run", str(tmp_path / "next"), "--map", str(runs[0]), "--watch", "--out", str(tmp_path / "out"), "--quiet"]
    done = CliRunner().invoke(app, [*words, "--set", "volume.voxel_size=0.02", "--set", "device=cpu"])
    assert done.exit_code == 0, done.output
    rows = [json.loads(line) for line in (tmp_path / "out" / WATCH_FILE).read_text().splitlines()]
    assert "disappeared" in {row["kind"] for row in rows}


def test_what_is_new_is_reported_within_a_second_and_what_passes_is_not(unchanged, tmp_path):
    recording, saved = unchanged.recordings[0], unchanged.maps[0].saved
    for step, expected in ((0.0, ["appeared"]), (0.03, [])):  # at rest, and passing at 0.9 m/s
        frames, poses = [], [np.eye(4)] * 30
        for index in range(30):
            depth = recording[0].depth.copy()
            left = round(90 + CAMERA.fx * step * index)
            depth[90:150, left : left + 60] = 1.0
            frames.append(replace(recording[0], depth=depth, timestamp=index / 30))
        rows = watched(saved, frames, poses, recording.camera, tmp_path)
        assert [row["kind"] for row in rows] == expected
    middle = CAMERA.points(np.array([120]), np.array([120]), np.array([1.0]))[0]
    rows = watched(saved, [replace(frames[0], timestamp=k / 30) for k in range(30)], poses, recording.camera, tmp_path)
    assert np.linalg.norm(np.array(rows[0]["centre"]) - middle) < 0.05
    left = [replace(recording[0], timestamp=(30 + k) / 30) for k in range(60)]  # who stayed goes on after a second
    stayed = [replace(frames[0], timestamp=k / 30) for k in range(30)]
    rows = watched(saved, stayed + left, [np.eye(4)] * 90, recording.camera, tmp_path)
    assert [(row["id"], row["kind"]) for row in rows] == [(1, "appeared"), (1, "withdrawn")]
