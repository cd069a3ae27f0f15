# SPDX-License-Identifier: Apache-2.0
"""Where what can be had again is kept for the next time."""

import os
from pathlib import Path


def cache_folder() -> Path:
    """Return the folder of both commands: loopclose under $XDG_CACHE_HOME or ~/.cache."""
    root = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(root) if Path(root).is_absolute() else Path.home() / ".cache") / "loopclose"
