# SPDX-License-Identifier: Apache-2.0
"""Folders of images, as public datasets and their tools lay them out."""
