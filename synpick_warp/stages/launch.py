"""Launching pixel kernels: blocks of whole tiles on the GPU, several threads on the CPU."""

from __future__ import annotations

from typing import Any

import warp as wp

BLOCK = 128
"""Threads of a block: four tiles of 8 x 4 pixels."""


def launch_pixels(kernel: wp.Kernel, pixels: int, inputs: list[Any], outputs: list[Any], device: wp.Device) -> None:
    """Launch a kernel over a flat range of pixels; its last input is where the range begins."""
    if device.is_cuda:
        wp.launch(kernel, dim=pixels, inputs=[*inputs, 0], outputs=outputs, device=device, block_dim=BLOCK)
        return
    wp.launch(kernel, dim=pixels, inputs=[*inputs, 0], outputs=outputs, device=device)
