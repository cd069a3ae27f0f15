# SPDX-License-Identifier: Apache-2.0
from slam.output.comparison.tables import Table, as_csv, as_latex, as_text

TABLE = Table(
    "a_b of 100 %",
    ("run", "APE (m)"),
    (("fr1_desk", "0.01"), ("x & y", "unknown")),
    (("matched", "595 of 595"), ("aligned", "SE(3)")),
)


def test_numbers_stand_to_the_right_and_notes_below():
    assert as_text(TABLE) == (
        "a_b of 100 %\n\n"
        "run       APE (m)\n"
        "fr1_desk     0.01\n"
        "x & y     unknown\n\n"
        "matched    595 of 595\n"
        "aligned    SE(3)"
    )


def test_latex_has_its_notes_and_nothing_that_it_would_take_for_a_command():
    latex = as_latex([TABLE])
    assert r"\caption{a\_b of 100 \%}" in latex and r"\begin{tabular}{lr}" in latex
    assert r"fr1\_desk & 0.01 \\" in latex and r"x \& y & unknown \\" in latex
    assert "matched: 595 of 595. aligned: SE(3)." in latex


def test_csv_has_the_keys_of_the_fullest_row():
    rows = [{"run": "a", "rmse": 0.1}, {"run": "b, c", "rmse": None, "matched": 3}]
    assert as_csv(rows) == 'run,rmse,matched\na,0.1,\n"b, c",,3\n'
