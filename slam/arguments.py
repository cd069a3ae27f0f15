# SPDX-License-Identifier: Apache-2.0
"""The command line of run_slam."""

from argparse import ArgumentParser
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from slam.config import Config, load_config

DEFAULT_RECOGNIZER = "learned"

_DESCRIPTION = """Track an RGB-D sequence, close its loops, correct the drift and explain it.

  run_slam demo                         render a room and run on it; needs no data
  run_slam fr1_desk                     a sequence of the TUM RGB-D benchmark, fetched if needed
  run_slam path/to/folder               a recording: TUM RGB-D, ICL-NUIM, 7-Scenes, ScanNet,
                                        Open3D, Redwood or RealSense, told by what it holds
  run_slam fr1_xyz fr1_desk             recordings of one camera, in the order of time: one map
  run_slam fr1_desk --verification.min-inliers 40 --out runs/strict

Writes trajectories, the pose graph, the loop ledger, a point cloud and report.html; open that."""


@dataclass(frozen=True)
class Arguments:
    """What run_slam was asked to do."""

    sequence: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SEQUENCE")]
    """Folder of a recording, short name of a TUM RGB-D benchmark sequence, or `demo`."""
    more: Annotated[
        tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[SEQUENCE ...]")
    ] = ()
    """Later recordings of the same camera, which are to make one map with the first."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for the outputs; default: runs/SEQUENCE, the names of several joined by +."""
    recognizer: Annotated[str, tyro.conf.arg(metavar="NAME")] = DEFAULT_RECOGNIZER
    """Place recognizer: an installed name, package.module:ClassName, or FILE.safetensors."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """TOML file with settings; flags win over it. Every run writes its own settings.toml."""
    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)

    @property
    def sequences(self) -> tuple[str, ...]:
        """All recordings, as they were named."""
        return self.sequence, *self.more

    @property
    def title(self) -> str:
        """The names of the recordings' folders, joined by +."""
        return "+".join(Path(each).resolve().name for each in self.sequences)


def parse(arguments: list[str]) -> Arguments:
    """Return the parsed command line; exits with code 2 and a message where it is wrong.

    Raises:
        SlamError: the settings file cannot be used.
    """
    defaults = Config()
    config_path = _config_path(arguments)
    if config_path is not None:
        defaults = load_config(config_path)
    return tyro.cli(
        tyro.conf.configure(tyro.conf.FlagConversionOff)(Arguments),
        prog="run_slam",
        description=_DESCRIPTION,
        args=arguments,
        default=Arguments(sequence=tyro.MISSING, settings=defaults),
    )


def _config_path(arguments: list[str]) -> Path | None:
    """Find --config before the rest is parsed: it holds the defaults of the other flags."""
    finder = ArgumentParser(add_help=False, allow_abbrev=False)
    finder.add_argument("--config", type=Path, nargs="?")  # tyro tells what it lacks
    found: Path | None = finder.parse_known_args(arguments)[0].config
    return found
