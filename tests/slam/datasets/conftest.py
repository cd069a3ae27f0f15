# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from slam.datasets import write_camera
from slam.types import Camera

CAMERA = Camera(32, 24, 30.0, 30.0, 15.5, 11.5, depth_scale=5000.0)
MakeFolder = Callable[..., Path]


@pytest.fixture
def make_folder(tmp_path: Path) -> MakeFolder:
    """Write a TUM folder of tiny frames: frame i is of colour (i, 100, 200), 1 + i / 10 m away."""

    def make(count: int = 6, *, color_suffix: str = "png", name: str = "tiny") -> Path:
        folder = tmp_path / name
        for kind in ("rgb", "depth"):
            (folder / kind).mkdir(parents=True)
        color_lines, depth_lines = ["# color images"], ["# depth maps"]
        for i in range(count):
            bgr = np.full((24, 32, 3), (200, 100, i), np.uint8)
            depth = np.full((24, 32), round(5000 * (1 + i / 10)), np.uint16)
            depth[0, 0] = 0
            cv2.imwrite(str(folder / f"rgb/{i}.{color_suffix}"), bgr)
            cv2.imwrite(str(folder / f"depth/{i}.png"), depth)
            color_lines.append(f"{100 + i / 10:.6f} rgb/{i}.{color_suffix}")
            depth_lines.append(f"{100.004 + i / 10:.6f} depth/{i}.png")
        (folder / "rgb.txt").write_text("\n".join(color_lines) + "\n")
        (folder / "depth.txt").write_text("\n".join(depth_lines) + "\n")
        write_camera(folder / "camera.toml", CAMERA)
        return folder

    return make
