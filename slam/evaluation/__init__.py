# SPDX-License-Identifier: Apache-2.0
"""How far from the truth a trajectory is."""
