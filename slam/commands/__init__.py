# SPDX-License-Identifier: Apache-2.0
"""The sub-commands of `run_slam`, one to a file with a `main` that takes what follows its name.

`drift_report` is a command of its own; what others share stands beside them.
"""

COMMANDS = {
    "batch": "run on many recordings, each by itself, here or on a Ray cluster",
    "compare": "show finished runs side by side: errors, loops, warnings, differing settings",
    "merge": "make one map of saved ones, by loops between them",
    "more-loops": "look for loops that a run did not try, once its map is solved",
    "reembed": "embed the places of a saved map by another recognizer",
    "replay": "decide about the loops of a run again, with other settings and without its images",
    "stress": "make a recording worse step by step, and draw what is tolerated",
}
"""What each does, by the name of its file, with - for _."""
