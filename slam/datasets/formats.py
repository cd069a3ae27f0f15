# SPDX-License-Identifier: Apache-2.0
"""Which format a folder is in, told by what it holds."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from placerec.files import is_file, is_folder
from slam.config import InputConfig
from slam.datasets.bags import open_bag
from slam.datasets.bags.bag import SUFFIXES
from slam.datasets.folders.icl_nuim import open_icl_nuim, open_icl_nuim_original
from slam.datasets.folders.open3d import open_open3d, open_realsense
from slam.datasets.folders.replica import open_replica
from slam.datasets.folders.scannet import open_scannet
from slam.datasets.folders.seven_scenes import open_seven_scenes
from slam.datasets.folders.tum import open_associations, open_tum
from slam.datasets.phones.record3d import open_record3d
from slam.datasets.phones.stray_scanner import open_stray_scanner
from slam.datasets.sequence import Sequence
from slam.types import SlamError


@dataclass(frozen=True)
class Format:
    """A way of laying out a recording.

    Attributes:
        name: for people.
        needs: what a folder must hold, as glob patterns; one of those that `|` separates will do.
        open: reads such a folder; raises LoopcloseError where a list, a pose, the camera or most
            images are not usable.
        without: what it must not hold, as glob patterns: what tells that it is of another format.
    """

    name: str
    needs: tuple[str, ...]
    open: Callable[[Path, InputConfig], Sequence]
    without: tuple[str, ...] = ()

    def fits(self, folder: Path) -> bool:
        """Return whether a folder can be read as this format."""
        return not self.missing(folder) and not any(
            _holds(folder, pattern) for pattern in self.without
        )

    def missing(self, folder: Path) -> tuple[str, ...]:
        """Return those of the needs that the folder does not meet."""
        return tuple(
            need
            for need in self.needs
            if not any(_holds(folder, pattern) for pattern in need.split("|"))
        )


def _holds(folder: Path, pattern: str) -> bool:
    """Return whether a folder holds such files, hidden ones apart."""
    return any(not path.name.startswith(".") for path in folder.glob(pattern))


_COLOR = "color/|rgb/|image/"
_CAMERA_FILES = ("camera_intrinsic.json", "intrinsic.json", "camera_primesense.json")
_INTRINSICS = "|".join((*_CAMERA_FILES, "camera.toml"))
_LISTS = ("rgb.txt", "depth.txt", "associations.txt", "groundtruth.txt", "*.freiburg")
_OF_OTHERS = (
    *_LISTS,
    "intrinsic/",
    "pose/",
    "timestamps.*",
    "*.csv",
    "intrinsics.json",
    "metadata*",
)

# In the order of asking: what asks for more comes before what it would also fit.
FORMATS = (
    Format("TUM RGB-D", ("rgb.txt", "depth.txt"), open_tum),
    Format("ICL-NUIM", ("associations.txt", "*.gt.freiburg"), open_icl_nuim),
    Format("associated images", ("associations.txt",), open_associations, without=_CAMERA_FILES),
    Format("ICL-NUIM as rendered", ("scene_*.png", "scene_*.depth"), open_icl_nuim_original),
    Format(
        "7-Scenes",
        ("frame-*.color.png|frame-*.color.jpg", "frame-*.depth.png"),
        open_seven_scenes,
    ),
    Format("Replica", ("results/frame*", "results/depth*"), open_replica),
    Format("ScanNet", ("color/", "depth/", "intrinsic/intrinsic_color.txt"), open_scannet),
    Format(
        "Stray Scanner",
        ("rgb.mp4|rgb/", "depth/", "odometry.csv", "camera_matrix.csv"),
        open_stray_scanner,
    ),
    Format("Record3D", ("metadata.json|metadata", "depth/*.exr|rgbd/*.depth"), open_record3d),
    Format(
        "RealSense",
        (_COLOR, "depth/", "timestamps.csv|timestamps.txt", "intrinsics.json"),
        open_realsense,
    ),
    Format("Open3D or Redwood", (_COLOR, "depth/", _INTRINSICS), open_open3d),
    Format("ROS 2 bag", ("metadata.yaml", "*.db3*|*.mcap*"), open_bag),
    Format("Open3D's samples", (_COLOR, "depth/"), open_open3d, without=_OF_OTHERS),
)


def open_sequence(path: Path, config: InputConfig) -> Sequence:
    """Open a recording in any known format.

    Raises:
        LoopcloseError: there is nothing, it fits no format, or what it holds cannot be used.
    """
    if not (is_file(path) or is_folder(path)):
        raise SlamError(
            "there is no such folder; give the folder of a recording, or a short name of the TUM"
            f" RGB-D benchmark such as fr1_desk: {path}"
        )
    if not is_folder(path):
        if path.suffix in SUFFIXES:
            return open_bag(path, config)
        raise SlamError(
            f"expected the folder of a recording, or a bag ({', '.join(SUFFIXES)}), found a file:"
            f" {path}"
        )
    try:
        found = find_format(path)
        if found is None:
            raise SlamError(_not_recognised(path))
        return found.open(path, config)
    except OSError as error:
        raise SlamError(f"cannot look into the folder: {error.strerror}: {path}") from error


def find_format(folder: Path) -> Format | None:
    """Return the format that a folder is in, or None."""
    return next((each for each in FORMATS if each.fits(folder)), None)


def _not_recognised(path: Path) -> str:
    entries = sorted(path.iterdir())
    seen = ", ".join(entry.name for entry in entries[:5]) + (", ..." if len(entries) > 5 else "")
    inner = next((entry for entry in entries if entry.is_dir() and find_format(entry)), None)
    lacks = [(each, each.missing(path)) for each in FORMATS]
    nearly = [
        f"{each.name} with {_said(lack)}"
        for each, lack in lacks
        if len(lack) == 1 < len(each.needs)
    ]
    hint = ""
    if inner:
        hint = f"; did you mean its folder {inner.name}?"
    elif nearly:
        hint = f"; it would be {', '.join(nearly)}"
    formats = "; ".join(f"{each.name}: {_said(each.needs)}" for each in FORMATS)
    known = "" if hint else f" ({formats})"
    return (
        f"no recording in a known format, the folder holds {seen or 'nothing'}{hint}{known}: {path}"
    )


def _said(needs: tuple[str, ...]) -> str:
    return ", ".join(need.replace("|", " or ") for need in needs)
