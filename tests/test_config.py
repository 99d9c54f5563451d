"""The configuration: strict, complete, readable again."""

import pytest

from dudmap.config import Config, keys
from dudmap.errors import ConfigError


def test_toml_round_trip(tmp_path):
    config = Config().override(["volume.voxel_size=0.02", "tracker.iterations=[4, 3, 2]", "dynamics.method=threshold"])
    config.save(tmp_path / "config.toml")
    assert Config.load(tmp_path / "config.toml") == config


def test_a_file_may_name_a_few_keys_only(tmp_path):
    (tmp_path / "mine.toml").write_text('preset = "thesis"\n[tracker]\nhuber = 0.03\n')
    config = Config.load(tmp_path / "mine.toml")
    assert config.tracker.huber == 0.03
    assert config.tracker.noise_weighting is False


def test_the_thesis_preset_has_the_thesis_values():
    config = Config().override(["preset=thesis"])
    assert config.volume.voxel_size == 0.01
    assert (config.tracker.huber, config.tracker.damping, config.tracker.color_weight) == (0.01, 0.02, 0.1325)
    assert config.similarity.threshold == 0.84
    assert (config.preprocess.filter_alpha, config.preprocess.filter_sigma_px) == (0.012, 4.0)
    assert config.tracker.stop == config.tracker.stop_coarse == 1e-3
    assert (config.volume.weighting, config.dynamics.method) == ("constant", "em")
    # eq. 4.57 needs distances beyond its threshold, and the band must hold the noise at the far end of the sensor
    band, sensor = config.volume.truncation_voxels * config.volume.voxel_size, config.sensor
    assert band > config.dynamics.noise_threshold
    assert band >= 3 * (sensor.sigma_base + sensor.sigma_scale * 4.0**2)
    assert not config.relocalization.enabled


@pytest.mark.parametrize(
    ("assignment", "says"),
    [
        ("tracker.hubr=0.1", "tracker.huber"),
        ("voxel_size=0.1", "volume.voxel_size"),
        ("volume.voxel_size=0", "greater than 0"),
        ("volume.voxel_size=-0.01", "greater than 0"),
        ("volume.voxel_size=big", "volume.voxel_size"),
        ("volume.voxel_size=nan", "finite"),
        ("dynamics.method=magic", "'em'"),
        ("preprocess.depth_min=9", "depth_min"),
        ("volume.max_readings=2", "no voxel would ever be trusted"),
        ("tracker.iterations=[1]", "one entry per level"),
        ("tracker.huber", "key=value"),
        ("preset=best", "thesis"),
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
