# SPDX-License-Identifier: Apache-2.0
"""An odometry from elsewhere: in which frame, clock and unit it is, and how far to trust it."""
