"""The configuration: strict, complete, readable again."""

import re

import pytest

from dudmap.config import Config, VolumeConfig, keys
from dudmap.errors import ConfigError
from dudmap.gone_keys import GONE


def test_toml_round_trip(tmp_path):
    config = Config().override(["volume.voxel_size=0.02", "tracker.iterations=[4, 3, 2]", "dynamics.enabled=false"])
    config.save(tmp_path / "config.toml")
    assert Config.load(tmp_path / "config.toml") == config


def test_a_file_may_name_a_few_keys_only(tmp_path):
    (tmp_path / "mine.toml").write_text("[tracker]\nhuber = 0.03\n")
    config = Config.load(tmp_path / "mine.toml")
    assert config.tracker.huber == 0.03
    assert config.tracker.color_weight == Config().tracker.color_weight


def test_the_system_of_the_thesis_has_the_values_of_the_thesis():
    thesis = Config().override(["system=thesis"]).thesis
    assert (thesis.tau, thesis.rho, thesis.lambda_0, thesis.upsilon) == (0.01, 0.01, 0.02, 0.1325)  # section 6.1
    assert (thesis.similarity, thesis.alpha, thesis.sigma_s) == (0.84, 12, 4)  # section 4.3
    assert (thesis.iterations, thesis.stop) == (5, 1e-3)  # algorithm 2
    assert thesis.d_max > thesis.theta, "eq. 4.57 needs distances beyond its threshold"


@pytest.mark.parametrize(
    ("assignments", "says"),
    [
        (["system=thesis", "tracker.huber=0.02"], "the system thesis has no parameter tracker.huber"),
        (["thesis.rho=0.02"], "the system dudmap has no parameter thesis.rho"),
    ],
)
def test_parameters_of_another_system_are_refused_by_name(assignments, says):
    with pytest.raises(ConfigError, match=says):
        Config().override(assignments).check_used()


def test_keys_of_earlier_versions_are_read_where_they_change_nothing(tmp_path):
    (tmp_path / "old.toml").write_text('preset = "default"\n[tracker]\nrobust = "huber"\n')
    assert Config.load(tmp_path / "old.toml") == Config()
    for key, (left, instead) in GONE.items():
        assert key not in keys()
        assert Config().override([f"{key}={str(left).lower()}"]) == Config()
        with pytest.raises(ConfigError, match=re.escape(f"{key} = 'other' is gone; {instead}")):
            Config().override([f"{key}=other"])
    near = Config.for_range("near")
    old = near.model_dump() | {"loops": near.loops.model_dump() | {"min_distance": 0.004}}
    assert Config.from_tree(old) == near  # as that version scaled it


@pytest.mark.parametrize(
    ("assignment", "says"),
    [
        ("tracker.hubr=0.1", "tracker.huber"),
        ("voxel_size=0.1", "volume.voxel_size"),
        ("volume.voxel_size=0", "greater than 0"),
        ("volume.voxel_size=-0.01", "greater than 0"),
        ("volume.voxel_size=big", "volume.voxel_size"),
        ("volume.voxel_size=nan", "finite"),
        ("dynamics.enabled=magic", "boolean"),
        ("preprocess.depth_min=9", "depth_min"),
        ("volume.max_readings=2", "no voxel would ever be trusted"),
        ("tracker.iterations=[1]", "one entry per level"),
        ("tracker.huber", "key=value"),
        ("system=best", "thesis"),
        ("tracker.huber.x=1", "not acceptable"),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence(assignment, says):
    with pytest.raises(ConfigError) as error:
        Config().override([assignment])
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_files_that_are_no_configuration(tmp_path):
    with pytest.raises(ConfigError, match="cannot read"):
        Config.load(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("[volume\nvoxel_size=")
    with pytest.raises(ConfigError, match="not valid TOML"):
        Config.load(tmp_path / "bad.toml")


def test_every_key_has_a_meaning():
    for key in keys():
        part, _, name = key.rpartition(".")
        owner = type(getattr(Config(), part)) if part else Config
        assert owner.model_fields[name].description, key


def test_parts_are_frozen():
    with pytest.raises(ValueError, match="frozen"):
        Config().tracker.huber = 1.0  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"volume": {"voxel_sizee": 0.02}}, "the nearest known key is 'volume.voxel_size'"),
        ({"volume": {"voxel_size": "large"}}, "volume.voxel_size = 'large' is not acceptable"),
        ({"preset": "thesis"}, "--system thesis"),
    ],
)
def test_a_configuration_made_in_python_gives_the_same_errors_as_a_file(values, said):
    with pytest.raises(ConfigError) as made:
        Config(**values)
    with pytest.raises(ConfigError) as read:
        Config.from_tree(values)
    assert str(made.value) == str(read.value)
    assert said in str(made.value)


def test_sections_are_given_as_mappings_or_as_objects():
    by_mapping = Config(volume={"voxel_size": 0.02})
    assert by_mapping == Config(volume=by_mapping.volume) == Config().override(["volume.voxel_size=0.02"])


@pytest.mark.parametrize("values", [{"voxel_sise": 0.02}, {"voxel_size": -1}, {"max_readings": 2}])
def test_a_section_made_in_python_gives_the_same_errors_as_a_file(values):
    with pytest.raises(ConfigError) as made:
        VolumeConfig(**values)
    with pytest.raises(ConfigError) as read:
        Config.from_tree({"volume": values})
    assert str(made.value).partition(" = ")[0] == str(read.value).partition(" = ")[0]
    assert str(made.value).rpartition(": ")[2] == str(read.value).rpartition(": ")[2]
