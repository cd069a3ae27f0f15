# SPDX-License-Identifier: Apache-2.0
"""Second-order pooling: not what the maps show where, but what they show together."""

import torch
from torch import Tensor, nn

POSITION_WEIGHT = 0.5
"""How far the two channels of position reach, from minus to plus."""
FAINT = 1e-4
"""Below it the root is all but linear: its slope stays finite at zero."""


class Covariance(nn.Module):
    """The signed square root of the covariance of the channels, and of them with position.

    Two views of a place from different sides show the same things elsewhere: the covariance of
    (N, C, h, w) maps changes little, while the maps themselves do. The root keeps strong
    co-occurrences from drowning the rest (bilinear pooling, Lin 2015). Position comes in as two
    more channels, so that layout counts without being everything.
    """

    def forward(self, maps: Tensor) -> Tensor:
        """Return the (N, (C + 2)(C + 3) / 2) upper triangles for (N, C, h, w) maps."""
        values = _with_position(maps.float()).flatten(start_dim=2)
        values = values - values.mean(dim=2, keepdim=True)
        covariance = values @ values.transpose(1, 2) / values.shape[2]
        rows, columns = torch.triu_indices(*covariance.shape[1:], device=maps.device)
        triangle = covariance[:, rows, columns]
        rooted: Tensor = triangle.sign() * ((triangle.abs() + FAINT).sqrt() - FAINT**0.5)
        return rooted


def _with_position(maps: Tensor) -> Tensor:
    height, width = maps.shape[2:]
    rows, columns = (
        POSITION_WEIGHT * torch.linspace(-1.0, 1.0, size, device=maps.device)
        for size in (height, width)
    )
    position = torch.stack(torch.meshgrid(rows, columns, indexing="ij"))
    return torch.cat([maps, position.expand(len(maps), -1, -1, -1)], dim=1)
