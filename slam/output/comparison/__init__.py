# SPDX-License-Identifier: Apache-2.0
"""Trajectories and runs compared: figures, never without what stands behind them."""
