# SPDX-License-Identifier: Apache-2.0
"""The pipeline: what takes frames in, and what it makes of them in the end."""

from slam.system.slam import Slam

__all__ = ["Slam"]
