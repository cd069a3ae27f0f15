# SPDX-License-Identifier: Apache-2.0
import csv
import json
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from placerec.errors import printable
from slam.commands.drift_report import main
from slam.datasets.pose_formats import FORMATS
from slam.geometry import se3
from slam.output.comparison import plots
from slam.types import SlamError

COUNT = 60
STAMPS_S = 1403636579.7 + 0.05 * np.arange(COUNT)
T_TRUTH = se3.exp(np.linspace(0.0, 4.0, COUNT)[:, None] * np.array([0.3, -0.4, 0.5, 1.0, 0.9, 0]))
T_ESTIMATE = T_TRUTH @ se3.exp(np.random.default_rng(2).normal(0.0, 0.01, (COUNT, 6)))
TUM, KITTI = FORMATS[:2]


def words(*values):
    return [f"{value:.9f}" for value in values]


def tum(poses, stamps_s=STAMPS_S):
    stamped = zip(stamps_s, poses, strict=True)
    return [" ".join(words(stamp_s, *TUM.numbers(T))) for stamp_s, T in stamped]


def kitti(poses):
    return [" ".join(words(*KITTI.numbers(T))) for T in poses]


def euroc(poses):
    lines = ["#timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z,v_x"]
    for stamp_s, T in zip(STAMPS_S, poses, strict=True):
        x, y, z, qx, qy, qz, qw = words(*TUM.numbers(T))
        lines.append(",".join([str(round(stamp_s * 1e9)), x, y, z, qw, qx, qy, qz, "0.5"]))
    return lines


@pytest.fixture
def drift_report(tmp_path, monkeypatch, capsys):
    """Run the command on files of lines; return the exit code, and what it said."""
    monkeypatch.chdir(tmp_path)

    def run(estimate, truth, *more):
        for name, lines in (("estimate.txt", estimate), ("truth.txt", truth)):
            (tmp_path / name).write_text("".join(f"{line}\n" for line in lines))
        code = main(["estimate.txt", "truth.txt", *more])
        printed = capsys.readouterr()
        return code, printed.out if code == 0 else printed.err

    return run


def flat(said):
    return " ".join(said.split())


def rmse(said, name):
    (line,) = [each for each in said.splitlines() if each.startswith(name)]
    return float(line.removeprefix(name).split()[0])


def test_a_table_and_what_stands_behind_it(drift_report):
    code, said = drift_report(tum(T_ESTIMATE), tum(T_TRUTH, STAMPS_S + 0.002))
    assert code == 0
    assert 0.005 < rmse(said, "APE (m)") < 0.03 and 0.3 < rmse(said, "APE (deg)") < 2.0
    assert {line.split("  ")[0] for line in said.splitlines()} >= {
        *("RPE 1 m (m)", "RPE 1 m (deg)", "RPE 1 s (m)", "RPE 1 s (deg)")
    }
    assert "60 of 60 poses of the estimate" in flat(
        said
    ) and "at most 2 ms apart (20 allowed)" in flat(said)
    assert "SE(3), over all matched positions" in flat(
        said
    ) and "the scale was not adjusted" in flat(said)


def test_a_file_of_any_format_gives_the_same_figures(drift_report):
    expected = rmse(drift_report(tum(T_ESTIMATE), tum(T_TRUTH))[1], "APE (m)")
    for estimate in (euroc(T_ESTIMATE), kitti(T_ESTIMATE)):
        code, said = drift_report(estimate, euroc(T_TRUTH))
        assert code == 0 and rmse(said, "APE (m)") == expected
    assert "by row: not both files have times" in flat(said)


def test_nanoseconds_in_lines_like_those_of_tum_are_told_apart(drift_report):
    stamped = (line.split(" ", 1) for line in tum(T_ESTIMATE))
    lines = [f"{round(float(stamp_s) * 1e9)}.000000 {rest}" for stamp_s, rest in stamped]
    code, said = drift_report(lines, euroc(T_TRUTH))
    assert code == 0 and "60 of 60 poses of the estimate" in flat(said)


def test_what_is_missing_is_told(drift_report):
    stamps_s = 1403636579.7 + 0.05 * np.arange(COUNT) * 4
    code, said = drift_report(tum(T_ESTIMATE[:30], stamps_s[:30]), tum(T_TRUTH, stamps_s))
    assert code == 0
    assert "30 of 60 of the truth" in flat(said)
    assert "6.00 of 11.80 s of the truth have no estimate, in 1 gap(s)" in flat(said)


def test_a_line_leaves_the_rotation_open(drift_report):
    straight = np.eye(4)[None].repeat(COUNT, axis=0)
    straight[:, 0, 3] = np.arange(COUNT)
    code, said = drift_report(tum(straight), tum(straight))
    assert code == 0 and "lie on a line, so that the rotation about it cannot be told" in flat(said)
    assert "APE (deg) unknown" in flat(said)


def test_files_for_a_paper(drift_report, tmp_path):
    asked = ("--align", "sim3", "--rpe", "0.5m,1m,1s,10f", "--out", "report")
    code, said = drift_report(tum(T_ESTIMATE), tum(T_TRUTH), *asked)
    assert code == 0 and "the scale was adjusted, by" in flat(said)
    out = tmp_path / "report"
    rows = list(csv.DictReader((out / "table.csv").open()))
    assert [(row["metric"], row["delta"], row["unit"]) for row in rows][:4] == [
        *(("APE", "", "m"), ("APE", "", "deg"), ("RPE", "0.5 m", "m"), ("RPE", "0.5 m", "deg"))
    ]
    assert {(row["alignment"], row["matched"]) for row in rows} == {("Sim(3)", "60")}
    figures = json.loads((out / "figures.json").read_text())
    assert figures["figures"][0]["rmse"] == float(rows[0]["rmse"])
    assert figures["evidence"]["scale"] == pytest.approx(1.0, abs=0.02)
    latex = (out / "table.tex").read_text()
    assert latex.count(r"\toprule") == 1 and "RPE 0.5 m (deg) &" in latex
    assert r"60 of 60 poses of the estimate" in latex and r"100.0\% of" in latex
    for name in ("trajectories", "error_over_time", "rpe_over_length"):
        root = ElementTree.parse(out / f"{name}.svg").getroot()
        assert "60 of 60 poses, Sim(3), scale" in "".join(root.itertext())
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    drift_report(tum(T_ESTIMATE), tum(T_TRUTH), *asked)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


@pytest.mark.parametrize("name", [r"a$\frac$b", "_old", "x\udcff", "<a&b>"])
def test_a_file_of_any_name_is_in_the_legend(tmp_path, monkeypatch, capsys, name):
    monkeypatch.chdir(tmp_path)
    for file, poses in ((name, T_ESTIMATE), ("truth.txt", T_TRUTH)):
        (tmp_path / file).write_text("".join(f"{line}\n" for line in tum(poses)))
    assert main([name, "truth.txt", "--out", "report"]) == 0
    for drawing in ("trajectories", "error_over_time", "rpe_over_length"):
        root = ElementTree.parse(tmp_path / "report" / f"{drawing}.svg").getroot()
        assert f"{printable(name)}: 60 of 60 poses" in "".join(root.itertext())


def test_tables_are_kept_where_nothing_can_be_drawn(drift_report, monkeypatch, tmp_path):
    def fail(*_, **__):
        raise SlamError("no drawings today")

    monkeypatch.setattr(plots, "plots", fail)
    code, said = drift_report(tum(T_ESTIMATE), tum(T_TRUTH), "--out", "report")
    assert code == 2 and "no drawings today" in said
    names = {path.name for path in (tmp_path / "report").iterdir()}
    assert names == {"table.csv", "table.tex", "figures.json"}


def change(lines, number, line):
    return [*lines[:number], line, *lines[number + 1 :]]


GOOD = tum(T_TRUTH)


@pytest.mark.parametrize(
    ("estimate", "more", "complaint"),
    [
        (change(GOOD, 5, GOOD[4]), (), "line 6 has the time of line 5"),
        ([*GOOD[:5], *GOOD[4:2:-1], *GOOD[5:]], (), "line 6 has the time of line 5"),
        ([*GOOD[5:], *GOOD[:5]], (), "line 56 has a time before that of line 55"),
        (change(GOOD, 5, GOOD[5].replace("0.", "nan", 1)), (), "line 6 holds something else"),
        (change(GOOD, 5, "1403636579.95 1e300 0 0 0 0 0 1"), (), "a place can have"),
        (["# nothing"], (), "the file holds no pose"),
        (GOOD[:2], (), "only 2 of 2 poses have one of the truth in time, 3 are needed"),
        (kitti(T_TRUTH[1:]), (), "59 of the estimate and 60 of the truth"),
        (kitti(T_TRUTH), ("--rpe", "1s"), "there are no times"),
        (GOOD, ("--rpe", "1x"), "'1x' is no distance of two poses"),
        (GOOD, ("--align", "yaw"), "--align"),
        (GOOD, ("--max-time-difference", "-1"), "it has to be above 0"),
        (GOOD, ("--out", "truth.txt"), "cannot make the folder"),
    ],
)
def test_bad_input_ends_in_one_line(drift_report, estimate, more, complaint):
    code, said = drift_report(estimate, GOOD, *more)
    assert code == 2
    assert said.startswith("drift_report: ") and said.count("\n") == 1 and complaint in said


def test_a_file_that_is_not_there_is_named(capsys):
    assert main(["nothing.txt", "truth.txt"]) == 2
    assert "No such file" in capsys.readouterr().err
