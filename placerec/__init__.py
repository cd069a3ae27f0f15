# SPDX-License-Identifier: Apache-2.0
"""What a place looks like: recognizers that turn an image into a point on the unit sphere."""
