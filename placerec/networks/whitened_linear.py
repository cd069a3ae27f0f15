# SPDX-License-Identifier: Apache-2.0
"""A fully connected layer that can be taught without losing what it starts with."""

import torch
from torch import Tensor, nn
from torch.nn import functional


class WhitenedLinear(nn.Module):
    """A fully connected layer that sees its input as white: centred, all directions as strong.

    As one matrix the layer would be `weight @ whitening`. Learning the first factor alone is what
    makes it learnable: the maps' values differ so much in strength that steps of one size on the
    whole matrix undo its weak rows long before the strong ones have moved.

    Attributes:
        weight, bias: (D, K), (D,); what is learned.
        whitening, mean: (K, F), (F,); fixed.
    """

    whitening: Tensor
    mean: Tensor

    def __init__(self, features: int, components: int, dimension: int) -> None:
        """Make a layer from F values by K whitened ones to D, all zero."""
        super().__init__()
        self.in_features, self.out_features = features, dimension
        self.weight = nn.Parameter(torch.zeros(dimension, components))
        self.bias = nn.Parameter(torch.zeros(dimension))
        self.register_buffer("whitening", torch.zeros(components, features))
        self.register_buffer("mean", torch.zeros(features))

    def forward(self, values: Tensor) -> Tensor:
        """Return (N, D) of (N, F) values."""
        white = functional.linear(values - self.mean, self.whitening)
        return functional.linear(white, self.weight, self.bias)

    def merged(self) -> nn.Linear:
        """Return the same layer as one matrix."""
        layer = nn.Linear(self.in_features, self.out_features)
        weight = self.weight.double() @ self.whitening.double()
        with torch.no_grad():
            layer.weight.copy_(weight)
            layer.bias.copy_(self.bias.double() - weight @ self.mean.double())
        return layer
