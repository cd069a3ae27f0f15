# SPDX-License-Identifier: Apache-2.0
import sys

import pytest

from slam.__main__ import main

QUICK = ("--map.write", "False", "--recognizer", "gradients")


@pytest.fixture(scope="session")
def run():
    """Return what runs on a recording, quickly and without a page, into a folder."""

    def made(recording, folder, *settings, code=0):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "path", list(sys.path))
            patch.setattr("slam.output.run_folder._write_report", lambda path, *_: path.touch())
            assert main([str(recording), *QUICK, "--out", str(folder), *settings]) == code
        return folder

    return made
