# SPDX-License-Identifier: Apache-2.0
"""`placerec evaluate`: how well do recognizers tell places apart, and what do they cost?"""

from typing import Annotated

import tyro

from placerec.commands.data import RECOGNIZER, describe, embed_data, open_data
from placerec.cost import measure_cost
from placerec.evaluation import evaluate as evaluate_embeddings
from placerec.evaluation_table import LEGEND, Measured, evaluation_table
from placerec.recognizer import RecognizerError, available, load


def evaluate(
    data: Annotated[
        tuple[str, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="DATA ...", help_behavior_hint="(at least one)"),
    ],
    /,
    recognizers: Annotated[
        tuple[str, ...],
        tyro.conf.arg(metavar=f"{RECOGNIZER} ...", help_behavior_hint="(default: all installed)"),
    ] = (),
) -> int:
    """Measure how well recognizers tell places apart, and what they cost, as a Markdown table.

    Example: placerec evaluate rgbd_dataset_freiburg1_desk corridor --recognizers gradients

    Args:
        data: folders of images, each in one of these formats:
            - rgb.txt, groundtruth.txt: TUM RGB-D
            - Images/, *GroundTruth.mat: New College, City Centre
            - query/, ref/: two drives of one path
            - dataset.csv: clips; the test floors, or as named
            after a colon, FOLDER:validation or FOLDER:train
        recognizers: installed names, package.module:ClassName, or trained weights.
    """
    if not data:
        raise RecognizerError("evaluate needs at least one folder of images; see --help")
    names = recognizers or available()
    loaded = [(name, load(name)) for name in names]
    rows = []
    for dataset in map(open_data, data):
        for name, recognizer in loaded:
            embeddings, embed_s = embed_data(name, recognizer, dataset)
            found = evaluate_embeddings(dataset, embeddings)
            rows.append(Measured(dataset.name, name, found, measure_cost(embeddings, embed_s)))
        print(describe(dataset))
    print(f"\n{evaluation_table(rows)}\n\n{LEGEND}")
    return 0
