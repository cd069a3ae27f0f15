# SPDX-License-Identifier: Apache-2.0
import pytest

from slam.commands.named_recordings import named_recordings
from slam.types import SlamError


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with two recordings of one name, from beside which names are typed."""
    for each in ("mon/cam", "tue/cam", "here/bag"):
        (tmp_path / "data" / each).mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "data"


def listed(place, text):
    (place / "list.txt").write_text(text)
    return [(each.name, each.recording) for each in named_recordings(["data/list.txt"])]


def test_a_list_is_read_relative_to_itself_and_names_of_no_path_stay(place):
    text = "# all of ours\n\nmon/cam\n  cam_b = tue/cam  \ndemo\nfr1_desk\n/not/here\ngone\n"
    assert listed(place, text) == [
        ("cam", str(place / "mon" / "cam")),
        ("cam_b", str(place / "tue" / "cam")),
        ("demo", "demo"),
        ("fr1_desk", "fr1_desk"),
        ("here", "/not/here"),
        ("gone", str(place / "gone")),
    ]


def test_lists_and_recordings_can_be_typed_side_by_side(place):
    (place / "list.txt").write_text("here/bag\n")
    found = named_recordings(["data/mon/cam/", "data/list.txt"])
    assert [each.name for each in found] == ["cam", "bag"]
    assert found[0].recording == str(place / "mon" / "cam")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("mon/cam\ntue/cam\n", "two runs would be called cam; in a list, `NAME = RECORDING`"),
        ("a/b = mon/cam\n", "a name that a folder can have, not 'a/b'"),
        (".. = mon/cam\n", "not '..'"),
        ("# nothing\n", "there is no recording in data/list.txt"),
    ],
)
def test_what_cannot_be_a_batch_is_one_line(place, text, told):
    with pytest.raises(SlamError, match=r"^[^\n]+$") as error:
        listed(place, text)
    assert told in str(error.value)
