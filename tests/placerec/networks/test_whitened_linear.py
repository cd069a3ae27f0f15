# SPDX-License-Identifier: Apache-2.0
import torch

from placerec.networks.pooling import WhitenedLinear


def test_sees_its_input_centred_and_whitened():
    layer = WhitenedLinear(3, 2, 1)
    with torch.no_grad():
        layer.mean.copy_(torch.tensor([1.0, 2.0, 3.0]))
        layer.whitening.copy_(torch.tensor([[2.0, 0.0, 0.0], [0.0, 0.0, 0.5]]))
        layer.weight.copy_(torch.tensor([[10.0, 100.0]]))
        layer.bias.copy_(torch.tensor([7.0]))
    values = torch.tensor([[2.0, 9.0, 5.0]])  # centred (1, 7, 2), white (2, 1)
    assert layer(values).item() == 10 * 2 + 100 * 1 + 7
    torch.testing.assert_close(layer.merged()(values), layer(values))
