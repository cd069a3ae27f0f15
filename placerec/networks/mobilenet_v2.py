# SPDX-License-Identifier: Apache-2.0
"""MobileNetV2's convolutions (Sandler 2018), batch norms folded in, padded as TensorFlow does."""

from collections import OrderedDict
from functools import cache

import torch
from torch import Tensor, nn
from torch.nn import functional

from placerec.networks.preprocessing import Preprocessing
from placerec.networks.trunk import Trunk, with_random_weights

_STAGES = (
    *((1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2)),
    *((6, 96, 3, 1), (6, 160, 3, 2), (6, 320, 1, 1)),
)
"""Per stage: expansion, channels, blocks, stride of its first block."""


class _SameConv(nn.Conv2d):
    """A 3x3 convolution with stride 2 whose surplus padding goes to the right and the bottom."""

    def forward(self, maps: Tensor) -> Tensor:
        height, width = maps.shape[-2:]
        padding = (width % 2, 1, height % 2, 1)  # left, right, top, bottom
        return super().forward(functional.pad(maps, padding))


def _conv3x3(channels_in: int, channels: int, stride: int, groups: int = 1) -> nn.Conv2d:
    if stride == 1:
        return nn.Conv2d(channels_in, channels, kernel_size=3, padding=1, groups=groups)
    return _SameConv(channels_in, channels, kernel_size=3, stride=stride, groups=groups)


class _InvertedResidual(nn.Module):
    """Expand, filter each channel on its own, project; added to the input where shapes allow."""

    def __init__(self, channels_in: int, channels: int, expansion: int, stride: int) -> None:
        super().__init__()
        hidden = channels_in * expansion
        self.has_shortcut = stride == 1 and channels_in == channels
        self.expand = nn.Conv2d(channels_in, hidden, kernel_size=1) if expansion > 1 else None
        self.depthwise = _conv3x3(hidden, hidden, stride, groups=hidden)
        self.project = nn.Conv2d(hidden, channels, kernel_size=1)

    def forward(self, maps: Tensor) -> Tensor:
        hidden = maps if self.expand is None else functional.relu6(self.expand(maps))
        projected: Tensor = self.project(functional.relu6(self.depthwise(hidden)))
        return maps + projected if self.has_shortcut else projected


def _layers() -> nn.Sequential:
    stem = nn.Sequential(_conv3x3(3, 32, stride=2), nn.ReLU6())
    layers: OrderedDict[str, nn.Module] = OrderedDict(stem=stem)
    channels_in = 32
    for expansion, channels, blocks, first_stride in _STAGES:
        for stride in (first_stride, *(1,) * (blocks - 1)):
            block = _InvertedResidual(channels_in, channels, expansion, stride)
            layers[f"block{len(layers) - 1}"] = block
            channels_in = channels
    return with_random_weights(nn.Sequential(layers))


def _name_in_file(parameter: str) -> str:
    """Return `conv03.weight` for the fourth convolution's weight: the file numbers them."""
    layer, kind = parameter.rsplit(".", 1)
    return f"conv{_convolutions().index(layer):02d}.{kind}"


@cache
def _convolutions() -> tuple[str, ...]:
    with torch.device("meta"):  # names only, no numbers
        modules = _layers().named_modules()
    return tuple(name for name, module in modules if isinstance(module, nn.Conv2d))


MOBILENET_V2 = Trunk(
    name="mobilenet_v2",
    build=_layers,
    preprocessing=Preprocessing(
        width_px=192, height_px=144, mean=(128.0, 128.0, 128.0), scale=(128.0, 128.0, 128.0)
    ),
    blocks={"stem": 1} | {f"block{number}": number + 2 for number in range(17)},
    name_in_file=_name_in_file,
)
