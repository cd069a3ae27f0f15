# SPDX-License-Identifier: Apache-2.0
import pytest

from placerec.datasets.tables import read_csv
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


def test_a_field_beyond_all_measure_is_refused(tmp_path):
    file = tmp_path / "table.csv"
    file.write_text("path,floor\na,b\n" + "x" * 200_000 + ",c\n")
    with pytest.raises(LoopcloseError, match="line 3 of the table: field larger than"):
        list(read_csv(file, ("path", "floor")))
