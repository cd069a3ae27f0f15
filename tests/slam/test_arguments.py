# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from slam.cli import parse
from slam.config import Config, to_toml
from slam.types import SlamError


def settings_file(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return path


def refuse(arguments, capsys):
    """Return what is printed to stderr while the arguments are refused with code 2."""
    with pytest.raises(SystemExit) as exited:
        parse(arguments)
    assert exited.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == "" and "Traceback" not in printed.err
    return " ".join(printed.err.replace("│", " ").split())


def test_a_sequence_is_all_that_is_needed():
    arguments = parse(["fr1_desk"])
    assert arguments.sequences == ("fr1_desk",) and arguments.title == "fr1_desk"
    assert arguments.out is None and arguments.config is None
    assert arguments.settings == Config()


def test_several_sequences_are_one_run(tmp_path):
    arguments = parse(["fr1_xyz", str(tmp_path / "later"), "--map.write", "False"])
    assert arguments.sequences == ("fr1_xyz", str(tmp_path / "later"))
    assert arguments.title == "fr1_xyz+later"
    for words in (["--out", "here", "a", "b", "c"], ["a", "--out", "here", "b", "c"]):
        assert parse(words).sequences == ("a", "b", "c")


def test_the_sequence_may_come_last():
    arguments = parse(["--out", "here", "--recognizer", "mine", "fr1_desk"])
    assert (arguments.sequence, arguments.out, arguments.recognizer) == (
        "fr1_desk",
        Path("here"),
        "mine",
    )


@pytest.mark.parametrize("name", ["min-inliers", "min_inliers"])
def test_a_setting_is_a_flag_named_by_section_and_option(name):
    arguments = parse(["demo", f"--verification.{name}", "40", "--map.write", "False"])
    assert arguments.settings.verification.min_inliers == 40
    assert arguments.settings.map.write is False
    changed = Config().model_copy(
        update={
            "verification": Config().verification.model_copy(update={"min_inliers": 40}),
            "map": Config().map.model_copy(update={"write": False}),
        }
    )
    assert arguments.settings == changed


def test_settings_without_a_default_can_be_given():
    arguments = parse(["x", "--input.camera", "cam.toml", "--loop.min-similarity", "0.5"])
    assert arguments.settings.input.camera == Path("cam.toml").absolute()
    assert arguments.settings.loop.min_similarity == 0.5


@pytest.mark.parametrize("style", ["--config {}", "--config={}"])
def test_flags_win_over_the_file_and_the_file_over_the_defaults(tmp_path, style):
    path = settings_file(
        tmp_path, "[verification]\nmin_inliers = 40\nmin_matches = 30\n[map]\nwrite = false\n"
    )
    flags = ["--verification.min-inliers", "50"]
    arguments = parse(["demo", *style.format(path).split(), *flags])
    verification = arguments.settings.verification
    assert (verification.min_inliers, verification.min_matches) == (50, 30)
    assert verification.ransac_iterations == Config().verification.ransac_iterations
    assert arguments.settings.map.write is False
    assert arguments.config == path


def test_written_settings_give_the_same_settings(tmp_path):
    first = parse(["demo", "--input.depth-scale", "1000", "--odometry.links", "2"]).settings
    path = settings_file(tmp_path, to_toml(first))
    assert parse(["demo", "--config", str(path)]).settings == first


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[verification\n", "not valid TOML"),
        ("[verification]\nmin_inlers = 3\n", r"no setting verification\.min_inlers"),
        ("[verifikation]\nmin_inliers = 3\n", "no setting verifikation"),
        ("[verification]\nmin_inliers = 0\n", r"verification\.min_inliers = 0: .*greater than 0"),
        ("[map]\nwrite = 'perhaps'\n", r"map\.write = 'perhaps'"),
        ("[loop]\nmin_similarity = nan\n", r"loop\.min_similarity = nan"),
        ("map = 3\n", "map = 3"),
    ],
)
def test_a_bad_settings_file_is_one_line_that_names_it(tmp_path, text, message):
    path = settings_file(tmp_path, text)
    with pytest.raises(SlamError, match=message) as error:
        parse(["demo", "--config", str(path)])
    assert "\n" not in str(error.value) and str(error.value).endswith(str(path))


def test_a_settings_file_that_is_not_there_is_one_line(tmp_path):
    with pytest.raises(SlamError, match=r"cannot read the settings file: .*none\.toml"):
        parse(["demo", "--config", str(tmp_path / "none.toml")])


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        (["--verification.min-inliers", "0"], ["min_inliers", "greater than 0"]),
        (["--verification.min-inliers", "many"], ["--verification.min-inliers", "many"]),
        (["--loop.min-similarity", "3"], ["min_similarity", "less than or equal to 1"]),
        (["--map.voxel-m", "nan"], ["voxel_m"]),
        (["--map.voxel-m", "1e-9"], ["voxel_m", "greater than or equal to 0.0001"]),
        (["--verification.min-inlers", "3"], ["--verification.min-inliers"]),
        (["--config"], ["--config"]),
    ],
)
def test_a_bad_flag_is_refused_by_name(capsys, flags, told):
    message = refuse(["demo", *flags], capsys)
    assert all(part in message for part in told), message


def test_nothing_at_all_asks_for_a_sequence(capsys):
    assert "SEQUENCE" in refuse([], capsys)


def test_help_lists_every_setting_with_its_default(capsys):
    with pytest.raises(SystemExit) as exited:
        parse(["--help"])
    assert exited.value.code == 0
    text = capsys.readouterr().out
    for section, values in Config().model_dump().items():
        for name in values:
            assert f"--{section}.{name.replace('_', '-')}" in text
    assert "run_slam demo" in text and "(default: 25)" in text
