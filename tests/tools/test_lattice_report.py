"""Report on the structure of denoised frames: a planted lattice is found; noise, smooth light and edges are not."""

from __future__ import annotations

import numpy as np
import pytest

from synpick_warp.codes import Segment
from tools.reports.lattice import MAX_LATTICE, Lattice, measure_lattice

HEIGHT, WIDTH = 180, 320


def measure(luma: np.ndarray, period: int = 4, instance: np.ndarray | None = None) -> Lattice:
    image = np.repeat(np.rint(luma)[..., None], 3, axis=2)
    return measure_lattice(image, np.full(luma.shape, Segment.TOTE, np.uint8) if instance is None else instance, (period,))


def plain(noise: float = 1.0) -> np.ndarray:
    """A floor in smooth light with the edge of a shadow across it, and noise [grey levels]."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    edge = 30.0 / (1.0 + np.exp(-(0.8 * x + 0.6 * y - 180.0) / 3.0))
    return 90.0 + 0.05 * x + edge + np.random.default_rng(1).normal(0.0, noise, (HEIGHT, WIDTH))


def pattern(period: int, amplitude: float, oblique: bool = False) -> np.ndarray:
    """Dots, `period` apart, along the shadow's edge."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    waves = np.cos(2 * np.pi * (x + y) / period) if oblique else 0.5 * (np.cos(2 * np.pi * x / period) + np.cos(2 * np.pi * y / period))
    return amplitude * waves * np.exp(-(((0.8 * x + 0.6 * y - 180.0) / 15.0) ** 2))


@pytest.mark.parametrize("noise", [0.0, 0.3, 2.0])
def test_smooth_light_edges_and_noise_are_no_lattice(noise):
    for period in (4, 8, 12, 16):
        found = measure(plain(noise), period)
        assert found.ratio < 1.35
        assert found.share < 2.0


@pytest.mark.parametrize("period", [4, 8, 12, 16])
@pytest.mark.parametrize("oblique", [False, True])
def test_a_lattice_along_an_edge_is_found(period, oblique):
    found = measure(plain(0.5) + pattern(period, 4.0, oblique), period)
    assert found.ratio > 1.2 * MAX_LATTICE
    assert 1.0 < found.amplitude < 8.0


def test_a_lattice_of_another_period_is_none():
    assert measure(plain(0.5) + pattern(5, 4.0), 4).share == 0.0


def test_windows_with_objects_or_edges_of_the_tote_are_left_out():
    instance = np.full((HEIGHT, WIDTH), Segment.TOTE, np.uint8)
    instance[:, 100:] = 1
    assert measure(plain(), 4, instance).windows < measure(plain(), 4).windows / 2
    assert measure(plain(), 4, np.full_like(instance, 3)) == Lattice(0.0, 0.0, 0.0, 0)
