"""Measure of periodic image artefacts (Welch, 1967): windowed power spectra at grid frequencies, relative to neighbouring frequencies."""

import numpy as np

from synpick_warp.codes import Segment

WINDOW = 32
"""Least width of a window [px]; a window has at least four periods."""
VISIBLE = 1.0
"""Least amplitude of a visible lattice [grey levels]."""
STRONG = 3.0
"""Least ratio of the amplitudes at a grid frequency and at its neighbours, for a window to count as one with a lattice."""
FLOOR = 0.1
"""Amplitude that is added to the neighbours' [grey levels]: the amplitude that rounding to 8 bits causes at one frequency."""
NOISE_RATIO = float(np.exp(np.euler_gamma))
"""Arithmetic over geometric mean of the power spectrum of white noise. Neighbours are averaged geometrically, so that a few strong edge
frequencies do not dominate, and multiplied by this ratio."""
LUMINANCE = np.array([0.299, 0.587, 0.114])
"""Weights of sRGB values in luma (Rec. 601)."""


def measure_lattice(image: np.ndarray, instance: np.ndarray, periods: tuple[int, ...]) -> tuple[float, float, int]:
    """Measure periodic artefacts: power spectra of image windows at the frequencies (i / P, j / P), relative to neighbouring frequencies.

    Windows are several periods P wide, overlap by half (Welch's method), and are tapered by a Hann window; only windows within one surface
    count. Neighbours of a frequency lie two or three bins away, for a frequency on an axis along that axis, since straight edges have most
    of their power there. The ratio over all windows weights each window by the inverse of its neighbours' power; otherwise the few
    windows with strong edges would decide it.

    Args:
        image: Grey levels (H, W, 3).
        instance: Segmentation ids (H, W); windows that show more than the tote or the table alone are left out.
        periods: Periods P [px]; the result is that of the one with the strongest lattice.

    Returns:
        RMS amplitude at the strongest grid frequency over all windows, relative to neighbouring ones, 1: no lattice; share of windows
        with an amplitude of at least VISIBLE and STRONG times that of neighbouring frequencies; number of windows.
    """
    return max(_measure_period(image, instance, period) for period in periods)


def _measure_period(image: np.ndarray, instance: np.ndarray, period: int) -> tuple[float, float, int]:
    """Measure the artefacts of one period; see `measure_lattice`."""
    lattice, near = _window_spectra(image, instance, period)
    near = near + FLOOR**2
    strong = (lattice > VISIBLE**2) & (lattice > STRONG**2 * near)
    weight = 1.0 / near.mean(axis=1, keepdims=True)
    ratio = float(np.sqrt(((weight * lattice).sum(axis=0) / (weight * near).sum(axis=0)).max()))
    return ratio, float(strong.any(axis=1).mean()), len(lattice)


def _window_spectra(image: np.ndarray, instance: np.ndarray, period: int) -> tuple[np.ndarray, np.ndarray]:
    """Squared amplitudes (window, frequency) [grey levels²]: at the grid's frequencies, and the mean of their neighbours."""
    periods = max(4, round(WINDOW / period))
    size, half = period * periods, period // 2
    taper = np.outer(*2 * [np.hanning(size + 1)[:size]])
    at = [(i, j) for i in range(half + 1) for j in range(-half, half + 1) if (i or j > 0) and -period < 2 * j]
    near = [_neighbours(i * periods, j * periods, size, periods) for i, j in at]
    rows, columns = (periods * np.array(each) % size for each in zip(*at, strict=True))
    luma = image @ LUMINANCE
    found: list[tuple[np.ndarray, list[float]]] = []
    for top in range(0, luma.shape[0] - size + 1, size // 2):
        for left in range(0, luma.shape[1] - size + 1, size // 2):
            ids = instance[top : top + size, left : left + size]
            if ids[0, 0] in (Segment.TABLE, Segment.TOTE) and (ids == ids[0, 0]).all():
                window = luma[top : top + size, left : left + size]
                # A sinusoid of amplitude a has the spectrum a / 2 times the window's sum at either of its two frequencies.
                flat = taper * (window - (taper * window).sum() / taper.sum())
                power = np.abs(np.fft.fft2(flat) * (2.0 / taper.sum())) ** 2
                found.append((power[rows, columns], [NOISE_RATIO * float(np.exp(np.log(power[each] + 1e-12).mean())) for each in near]))
    first, second = zip(*found, strict=True)
    return np.array(first), np.array(second)


def _neighbours(row: int, column: int, size: int, periods: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the spectral bins that a bin (row, column) is compared with; none lies beside a bin of the grid's frequencies."""
    steps = [(i, j) for i in range(-3, 4) for j in range(-3, 4) if max(abs(i), abs(j)) >= 2]
    if row == 0 or column == 0:
        steps = [(i, j) for i, j in steps if (i == 0 if row == 0 else j == 0)]
    bins = [(row + i, column + j) for i, j in steps]
    bins = [(r, c) for r, c in bins if min(r % periods, -r % periods) + min(c % periods, -c % periods) >= 2]
    bins = [(r, c) for r, c in bins if row == 0 or column == 0 or (abs(r % size) >= 2 and abs(c % size) >= 2)]
    return np.array([r % size for r, _ in bins]), np.array([c % size for _, c in bins])
