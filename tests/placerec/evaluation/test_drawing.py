# SPDX-License-Identifier: Apache-2.0
from itertools import islice
from xml.etree import ElementTree

import cv2
import matplotlib as mpl
import numpy as np

from placerec.evaluation.drawing import COLOURS, canvas, line_styles
from placerec.evaluation.figures import png, svg


def drawn(height_in=2.0):
    with canvas(height_in) as figure:
        figure.add_subplot(xlabel="recall").plot([0.0, 1.0], [1.0, 0.5])
    return figure


def test_files_are_whole_and_the_same_every_time():
    assert svg(drawn()) == svg(drawn())
    assert png(drawn()) == png(drawn())
    picture = cv2.imdecode(np.frombuffer(png(drawn()), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (220, 550, 3)
    assert ElementTree.fromstring(svg(drawn())).tag.endswith("svg")
    assert b">recall<" in svg(drawn())  # as text, which can be searched and read out


def test_the_look_is_nobody_elses():
    before = dict(mpl.rcParams)
    drawn()
    assert dict(mpl.rcParams) == before


def test_many_lines_can_be_told_apart():
    styles = list(islice(line_styles(), 3 * len(COLOURS)))
    assert len(set(styles)) == len(styles)
    assert [dashes for _, dashes in styles[: len(COLOURS)]] == ["-"] * len(COLOURS)
