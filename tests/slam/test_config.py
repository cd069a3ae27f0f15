# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest
from pydantic import ValidationError

from slam.config import Config, InputConfig, LoopConfig, MapConfig, load_config, to_toml
from slam.types import SlamError


def load(tmp_path, text):
    path = tmp_path / "settings.toml"
    path.write_text(text, encoding="utf-8")
    return load_config(path)


def error_of(tmp_path, text):
    with pytest.raises(SlamError) as caught:
        load(tmp_path, text)
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith("settings.toml")
    return message


def test_an_empty_file_means_the_defaults(tmp_path):
    assert load(tmp_path, "") == Config()


def test_settings_of_the_file_replace_the_defaults(tmp_path):
    config = load(tmp_path, "[verification]\nmin_inliers = 40\n[map]\nwrite = false\n")
    assert config.verification.min_inliers == 40
    assert not config.map.write
    assert config.verification.min_matches == Config().verification.min_matches


@pytest.mark.parametrize(
    "config",
    [
        Config(),
        Config(
            input=InputConfig(camera=Path('my "own"\\camera.toml'), depth_scale=1000.0),
            loop=LoopConfig(min_similarity=-0.25, min_gap=1),
            map=MapConfig(write=False),
        ),
        Config(input=InputConfig(camera=Path("/a\n[map]\t\r\x7f\x1b \U0001f600ä\u2028"))),
    ],
)
def test_toml_round_trip(tmp_path, config):
    assert load(tmp_path, to_toml(config)) == config


def test_a_name_that_no_settings_file_can_hold_is_refused():
    with pytest.raises(ValidationError, match="not in UTF-8; rename it"):
        InputConfig(camera=Path("caf\udce9.toml"))


@pytest.mark.parametrize(
    "name",
    [
        "features.count",
        "verification.ransac_iterations",
        "verification.min_matches",
        "loop.candidates",
        "odometry.links",
        "input.depth_scale",
    ],
)
def test_a_setting_that_would_take_days_or_all_memory_is_refused(tmp_path, name):
    section, key = name.split(".")
    message = error_of(tmp_path, f"[{section}]\n{key} = 2000000000\n")
    assert f"setting {name} = 2000000000: Input should be less than or equal to" in message


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SlamError, match=r"No such file or directory: .*absent\.toml$"):
        load_config(tmp_path / "absent.toml")


def test_a_folder_is_not_a_settings_file(tmp_path):
    with pytest.raises(SlamError, match="cannot read the settings file"):
        load_config(tmp_path)


def test_text_that_is_not_toml(tmp_path):
    assert "not valid TOML" in error_of(tmp_path, "[loop\n")


def test_bytes_that_are_not_text(tmp_path):
    path = tmp_path / "settings.toml"
    path.write_bytes(b"\x80\xff\x00")
    with pytest.raises(SlamError, match="not text in UTF-8"):
        load_config(path)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("loop.canditates", "did you mean loop.candidates? `run_slam --help-all`"),
        ("loop.min_gap_s", "did you mean loop.min_gap? `run_slam --help-all`"),
        ("elephants", "`run_slam --help-all` lists them all"),
    ],
)
def test_an_unknown_setting_is_named_with_one_that_it_is_like(tmp_path, name, hint):
    message = error_of(tmp_path, f"{name} = 3\n")
    assert f"no setting {name}; {hint}" in message


@pytest.mark.parametrize(
    ("setting", "value", "allowed"),
    [
        ("verification.min_inliers", "0", "greater than 0"),
        ("verification.min_inlier_ratio", "1.5", "less than or equal to 1"),
        ("verification.max_descriptor_distance", "2.5", "integer"),
        ("features.levels", '"many"', "integer"),
        ("map.voxel_m", "inf", "finite"),
        ("graph.inlier_probability", "1.0", "less than 1"),
    ],
)
def test_a_value_that_is_not_allowed(tmp_path, setting, value, allowed):
    message = error_of(tmp_path, f"{setting} = {value}\n")
    assert message.startswith(f"setting {setting} = ")
    assert value.strip('"') in message
    assert allowed in message


def test_a_section_cannot_change():
    with pytest.raises(ValidationError):
        Config().loop.candidates = 3
