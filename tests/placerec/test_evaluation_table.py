# SPDX-License-Identifier: Apache-2.0
import numpy as np

from placerec.cost import Cost
from placerec.evaluation import Curve, Evaluation
from placerec.evaluation_table import HEADER, Measured, evaluation_table


def test_markdown_table_lines_up():
    curve = Curve(np.array([0.9, 0.1]), np.array([1.0, 0.5]), np.array([0.5, 1.0]))
    evaluation = Evaluation(curve, curve, 0.25, 0.75)
    cost = Cost(embed_ms=12.34, compare_ms=0.000123, dimension=512, embedding_bytes=2048)
    rows = [Measured("a", "short", evaluation, cost), Measured("b", "longer", evaluation, cost)]
    lines = evaluation_table(rows).splitlines()
    assert len({len(line) for line in lines}) == 1
    assert len(lines) == 4
    cells = [cell.strip() for cell in lines[2].strip("|").split("|")]
    assert len(cells) == len(HEADER)
    assert " ".join(cells) == "a short 0.750 0.250 0.750 0.500 0.750 512 2.0 12.3 0.123"
    assert set(lines[1]) == set("|-: ")
