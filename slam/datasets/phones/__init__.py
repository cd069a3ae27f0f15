# SPDX-License-Identifier: Apache-2.0
"""Recordings of phones with LiDAR, as the apps that make them export them."""
