"""Segmentation networks, all from scratch: the U-Net of `tools.examples.train_online`, and a residual U-Net (Zhang et al., GRSL 2018)."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import torch  # pyright: ignore[reportMissingImports]
from torch import nn  # pyright: ignore[reportMissingImports]
from torch.nn import functional  # pyright: ignore[reportMissingImports]

from tools.examples.train_online import Network

DEPTHS = (2, 3, 4, 3)
"""Residual blocks of each level."""


def upsample(x: torch.Tensor, size: torch.Size) -> torch.Tensor:
    """Bilinear interpolation of features (B, C, H, W) to a height and width of `size`.

    Compiled code that upsamples by two takes `upsample_twofold`: PyTorch's operator runs in float32 under autocast, and its compiled
    backward pass accumulates by atomic additions, together 10 of the 27 ms of a training step (H200, U-Net of width 48).
    """
    if torch.compiler.is_compiling() and tuple(size) == (2 * x.shape[2], 2 * x.shape[3]):
        return upsample_twofold(x)
    return functional.interpolate(x, size=size, mode="bilinear", align_corners=False)


def upsample_twofold(x: torch.Tensor) -> torch.Tensor:
    """Bilinear upsampling of features (B, C, H, W) by a factor of two, with slices: they compile to one kernel, in the data type of `x`."""
    x = x.permute(0, 2, 3, 1)  # Channels are last in memory, and remain so.
    for axis in (1, 2):
        last = x.shape[axis] - 1
        before = torch.cat((x.narrow(axis, 0, 1), x.narrow(axis, 0, last)), axis)
        after = torch.cat((x.narrow(axis, 1, last), x.narrow(axis, last, 1)), axis)
        x = torch.stack((0.75 * x + 0.25 * before, 0.75 * x + 0.25 * after), axis + 1).flatten(axis, axis + 1)
    return x.permute(0, 3, 1, 2)


class UNet(Network):
    """U-Net of `tools.examples.train_online` with the upsampling of this module."""

    upsample = staticmethod(upsample)


class ResidualNetwork(nn.Module):
    """Residual U-Net: a stem of 1/2 of the image's size, levels of 1/2 to 1/16 with `width` to 8 x `width` channels, logits of 1/2.

    A pixel of its coarsest level sees about 210 pixels of the image to each side. With as many channels it takes 0.6 times the U-Net's
    operations, on tensors of a quarter of the size.
    """

    def __init__(self, classes: int, width: int, inputs: int = 3) -> None:
        super().__init__()
        widths = [width * factor for factor in (1, 2, 4, 8)]
        self.stem = _convolution(inputs, width, size=5, stride=2)
        self.down = nn.ModuleList(
            nn.Sequential(_convolution(before, after, stride=1 + (level > 0)), *(_Block(after) for _ in range(depth)))
            for level, (before, after, depth) in enumerate(zip([width, *widths], widths, DEPTHS, strict=False))
        )
        self.up = nn.ModuleList(nn.Sequential(_convolution(low + high, high), _Block(high)) for high, low in itertools.pairwise(widths))
        self.head = nn.Conv2d(width, classes, 1)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Logits (B, classes, H, W) of an image (B, inputs, H, W): uint8, or float32 as it is."""
        size = image.shape[2:]
        x, skips = self.stem(image.float().div(255).sub(0.5) if image.dtype == torch.uint8 else image), []
        for level in self.down:
            x = level(x)
            skips.append(x)
        for level, skip in zip(reversed(self.up), reversed(skips[:-1]), strict=True):
            x = level(torch.cat((upsample(x, skip.shape[2:]), skip), dim=1))
        return upsample(self.head(x), size)


class _Block(nn.Module):
    """Residual block of two 3 x 3 convolutions (He et al., CVPR 2016)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _convolution(channels, channels)
        self.second = nn.Sequential(nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Features of the size of `x`."""
        return functional.relu(x + self.second(self.first(x)))


def _convolution(before: int, after: int, size: int = 3, stride: int = 1) -> nn.Sequential:
    """Convolution with batch normalization and ReLU."""
    return nn.Sequential(nn.Conv2d(before, after, size, stride, size // 2, bias=False), nn.BatchNorm2d(after), nn.ReLU())


NETWORKS: dict[str, Callable[[int, int, int], nn.Module]] = {"unet": UNet, "residual": ResidualNetwork}
"""Constructors by name, of numbers of classes, of channels and of input channels."""
