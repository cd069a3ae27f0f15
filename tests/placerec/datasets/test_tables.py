# SPDX-License-Identifier: Apache-2.0
import pytest

from placerec.datasets.tables import read_csv, read_text
from placerec.errors import LoopcloseError


def test_csv_gives_the_named_columns_in_the_order_asked(tmp_path):
    file = tmp_path / "table.csv"
    file.write_text('path,other,floor\n"a,b.jpg",x,\nc.jpg,y,2\n')
    rows = list(read_csv(file, ("floor", "path")))
    assert rows == [(2, ("", "a,b.jpg")), (3, ("2", "c.jpg"))]


def test_blanks_behind_commas_do_not_count(tmp_path):
    file = tmp_path / "table.csv"
    file.write_text('path, floor\n"a, b.jpg", 2\n')
    assert list(read_csv(file, ("floor", "path"))) == [(2, ("2", "a, b.jpg"))]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "has no column floor or path"),
        ("path\na\n", "has no column floor: "),
        ("path,floor\na\n", "line 2 of the table is too short"),
    ],
)
def test_unfit_csv_is_refused(tmp_path, content, message):
    file = tmp_path / "table.csv"
    file.write_text(content)
    with pytest.raises(LoopcloseError, match=message):
        list(read_csv(file, ("floor", "path")))


def test_file_that_cannot_be_read_is_one_line(tmp_path):
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(LoopcloseError, match=r"binary\.txt is not text in UTF-8"):
        read_text(tmp_path / "binary.txt")
    with pytest.raises(LoopcloseError, match=r"cannot read gone\.csv: No such file"):
        list(read_csv(tmp_path / "gone.csv", ("a",)))
