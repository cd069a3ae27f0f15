# SPDX-License-Identifier: Apache-2.0
"""Where the camera went: RGB-D odometry, verified loop closures, a robust pose graph."""
