# SPDX-License-Identifier: Apache-2.0
"""Chooses the network to train on validation images; docs/choosing_the_network.md has the rule."""
