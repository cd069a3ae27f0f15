# SPDX-License-Identifier: Apache-2.0
"""Where each frame was taken: placed among the landmarks, or taken from another odometry."""
