"""Packaged goods of the embedded household set (obj_id 1 to 9 and 12): procedural tins, cartons and bottles with printed labels.

Lengths are in metres. The last number of a label, of a plain texture or of a tin's metal is the seed of its random details.
"""

from __future__ import annotations

import numpy as np

from synpick_warp.scenes.embedded import packs
from synpick_warp.scenes.embedded import textures as paint
from synpick_warp.scenes.embedded.packs import Label, Shape
from synpick_warp.scenes.modelling import ellipse

WHITE = (250, 250, 247)


def coffee_tin() -> Shape:
    """Shape of a large tin with a blue plastic lid; the same label on front and back."""
    label = Label(("COFFEE",), "GROUND DARK ROAST", "NET 410 g", (24, 40, 92), (196, 150, 60), WHITE, _beans, 100)
    ring, height = ellipse(0.1016, 0.1016, packs.SIDES), 0.140
    ends = {
        "top": paint.rings(256, ((34, 52, 120), (24, 38, 92)), 4.0),
        "bottom": paint.rings(256, (packs.SILVER, (150, 151, 156)), 3.0),
    }
    image = packs.wrapper(*packs.tin_label_size(ring, height), label, twice=True)
    return packs.tin(ring, height, image, ends, packs.SILVER, 108)


def cracker_carton() -> Shape:
    """Shape of a tall carton of crackers, with a printed label."""
    label = Label(("GOLDEN", "CRACKERS"), "BAKED WITH SEA SALT", "NET 411 g", (190, 28, 34), (240, 190, 60), WHITE, _crackers, 200)
    return packs.carton((0.062, 0.159, 0.212), label)


def sugar_carton() -> Shape:
    """Shape of a slim carton of sugar, with a printed label."""
    label = Label(("FINE", "SUGAR"), "PURE CANE", "NET 514 g", (246, 214, 70), (30, 74, 152), (22, 48, 110), _cubes, 300)
    return packs.carton((0.041, 0.091, 0.175), label)


def soup_tin() -> Shape:
    """Shape of a small soup tin with a paper label."""
    label = Label(("TOMATO", "SOUP"), "READY IN 5 MINUTES", "NET 305 g", (200, 34, 30), (248, 240, 222), WHITE, _tomato, 400)
    ring, height = ellipse(0.0676, 0.0676, packs.SIDES), 0.1018
    ends = {"top": packs.stamped_end(256, packs.SILVER, 409, "BEST 2030"), "bottom": packs.stamped_end(256, packs.SILVER, 410, "")}
    return packs.tin(ring, height, packs.wrapper(*packs.tin_label_size(ring, height), label), ends, packs.SILVER, 408)


def squeeze_bottle() -> Shape:
    """Shape of a flat mustard bottle with a nozzle. `levels`, `neck` and the band of the label: see `packs.bottle`."""
    label = Label(("MUSTARD",), "MILD & YELLOW", "NET 550 g", (244, 200, 32), (170, 30, 26), (150, 24, 22), _flowers, 500)
    levels = [
        (0.080, 0.050, 2.6, -0.0955),
        (0.090, 0.058, 2.6, -0.0945),
        (0.0945, 0.062, 2.6, -0.090),
        (0.0965, 0.064, 2.6, -0.080),
        (0.097, 0.0645, 2.6, -0.072),
        (0.097, 0.0645, 2.6, -0.04),
        (0.095, 0.063, 2.5, 0.0),
        (0.092, 0.062, 2.5, 0.022),
        (0.086, 0.060, 2.4, 0.034),
        (0.072, 0.054, 2.2, 0.044),
        (0.050, 0.046, 2.0, 0.051),
        (0.040, 0.040, 2.0, 0.053),
    ]
    neck = [
        (0.0175, 0.0525),
        (0.0178, 0.0535),
        (0.0178, 0.066),
        (0.0165, 0.0675),
        (0.009, 0.069),
        (0.0075, 0.072),
        (0.0045, 0.094),
        (0.003, 0.0955),
    ]
    images = {
        "label": packs.wrapper(packs.SHEET - 6, 360, label),
        "body": paint.plain((244, 200, 32), 508),
        "cap": paint.plain((232, 226, 210), 509),
    }
    return packs.bottle(levels, neck, (4, 7), images)


def fish_tin() -> Shape:
    """Shape of a flat round tin with the front of the label on its lid, and its side panels around the wall."""
    label = Label(("TUNA", "CHUNKS"), "IN SPRING WATER", "NET 171 g", (20, 96, 128), (240, 168, 40), WHITE, _fish, 600)
    ring, height = ellipse(0.0855, 0.0855, packs.SIDES), 0.0335
    width, rows = packs.tin_label_size(ring, height)
    third = width // 3
    strip = [packs.other_side(third, rows, label), packs.side(width - 2 * third, rows, label), packs.other_side(third, rows, label)]
    ends = {"top": packs.front(380, 380, label), "bottom": packs.stamped_end(256, packs.SILVER, 609, "BEST 2031")}
    return packs.tin(ring, height, np.concatenate(strip, axis=1), ends, packs.SILVER, 608)


def dessert_carton() -> Shape:
    """Shape of a flat carton of pudding, with a printed label."""
    label = Label(("CHOCOLATE", "PUDDING"), "JUST ADD MILK", "NET 187 g", (92, 52, 34), (236, 220, 190), WHITE, _swirl, 700)
    return packs.carton((0.111, 0.089, 0.0365), label)


def jelly_carton() -> Shape:
    """Shape of a small flat carton of jelly, with a printed label."""
    label = Label(("CHERRY", "JELLY"), "DESSERT POWDER", "NET 97 g", (206, 30, 80), (250, 214, 60), WHITE, _cherries, 800)
    return packs.carton((0.073, 0.086, 0.029), label)


def meat_tin() -> Shape:
    """Shape of a tin whose outline is a rounded rectangle."""
    label = Label(("POTTED", "MEAT"), "SLICED & SMOKED", "NET 370 g", (28, 52, 122), (250, 202, 40), (252, 224, 90), _slices, 900)
    ring, height = packs.label_ring(0.1005, 0.0580, 0.021), 0.0832
    ends = {"top": packs.stamped_end(256, packs.SILVER, 909, "PULL TO OPEN"), "bottom": packs.stamped_end(256, packs.SILVER, 910, "")}
    return packs.tin(ring, height, packs.wrapper(*packs.tin_label_size(ring, height), label), ends, packs.SILVER, 908)


def cleaner_bottle() -> Shape:
    """Shape of a large flat bottle with a blue screw cap. `levels`, `neck` and the band of the label: see `packs.bottle`."""
    label = Label(("SURFACE", "CLEANER"), "FRESH SCENT", "1 litre", (30, 104, 188), (250, 236, 70), WHITE, _bubbles, 1200, food=False)
    levels = [
        (0.086, 0.054, 2.6, -0.1252),
        (0.096, 0.062, 2.6, -0.1240),
        (0.1005, 0.066, 2.6, -0.119),
        (0.102, 0.0675, 2.6, -0.108),
        (0.102, 0.0675, 2.6, -0.100),
        (0.102, 0.0675, 2.6, -0.03),
        (0.102, 0.0675, 2.6, 0.030),
        (0.099, 0.066, 2.5, 0.038),
        (0.090, 0.062, 2.4, 0.050),
        (0.070, 0.053, 2.2, 0.064),
        (0.050, 0.045, 2.0, 0.075),
        (0.038, 0.037, 2.0, 0.083),
        (0.035, 0.035, 2.0, 0.095),
    ]
    neck = [(0.0185, 0.0925), (0.0192, 0.0935), (0.0192, 0.1190), (0.0180, 0.1240), (0.0160, 0.1252)]
    images = {
        "label": packs.wrapper(packs.SHEET - 6, 450, label),
        "body": paint.plain((238, 240, 240), 1208),
        "cap": paint.plain((26, 74, 160), 1209),
    }
    return packs.bottle(levels, neck, (4, 6), images)


def _beans(image: np.ndarray) -> None:
    """Draw beans onto a label."""
    for x, y in ((0.3, 0.62), (0.42, 0.72), (0.56, 0.6), (0.68, 0.72), (0.5, 0.82), (0.78, 0.6), (0.24, 0.76)):
        paint.dot(image, x, y, 0.062, (112, 66, 32))
        paint.dot(image, x - 0.008, y - 0.01, 0.045, (136, 84, 44))
        paint.fill(image, (x - 0.04, y - 0.006, x + 0.04, y + 0.006), (76, 44, 22))


def _crackers(image: np.ndarray) -> None:
    """Draw crackers onto a label."""
    for x, y in ((0.34, 0.6), (0.68, 0.58), (0.5, 0.72), (0.76, 0.78), (0.24, 0.78)):
        paint.dot(image, x, y, 0.155, (170, 110, 44))
        paint.dot(image, x, y, 0.143, (238, 196, 116))
        for angle in np.arange(8) * np.pi / 4:
            paint.dot(image, x + 0.09 * np.cos(angle), y + 0.067 * np.sin(angle), 0.012, (176, 122, 58))


def _cubes(image: np.ndarray) -> None:
    """Draw sugar cubes onto a label."""
    for x, y in ((0.2, 0.66), (0.38, 0.7), (0.56, 0.64), (0.3, 0.58), (0.66, 0.74)):
        paint.fill(image, (x, y, x + 0.15, y + 0.085), (208, 208, 214))
        paint.fill(image, (x + 0.012, y + 0.006, x + 0.138, y + 0.07), WHITE)


def _tomato(image: np.ndarray) -> None:
    """Draw tomatoes onto a label."""
    paint.fill(image, (0.0, 0.48, 1.0, 0.84), (248, 240, 222))
    for x in (0.28, 0.5, 0.72):
        paint.dot(image, x, 0.66, 0.14, (206, 40, 30))
        paint.dot(image, x - 0.03, 0.62, 0.035, (240, 130, 110))
        paint.dot(image, x, 0.535, 0.04, (60, 128, 50))


def _flowers(image: np.ndarray) -> None:
    """Draw mustard flowers onto a label."""
    paint.fill(image, (0.0, 0.48, 1.0, 0.84), (176, 32, 28))
    for x in (0.3, 0.5, 0.7):
        for angle in np.arange(6) * np.pi / 3:
            paint.dot(image, x + 0.045 * np.cos(angle), 0.66 + 0.045 * np.sin(angle), 0.05, (250, 216, 60))
        paint.dot(image, x, 0.66, 0.05, (210, 140, 24))


def _fish(image: np.ndarray) -> None:
    """Draw a fish onto a label."""
    paint.fill(image, (0.0, 0.5, 1.0, 0.84), (120, 186, 206))
    for x in np.linspace(-0.18, 0.18, 19):
        paint.dot(image, 0.48 + x, 0.67, 0.11 * float(np.sqrt(1 - (x / 0.2) ** 2)), (44, 66, 96))
    for step in np.linspace(0.0, 1.0, 9):
        paint.fill(image, (0.64 + 0.1 * step, 0.67 - 0.08 * step, 0.655 + 0.1 * step, 0.67 + 0.08 * step), (44, 66, 96))
    paint.dot(image, 0.36, 0.64, 0.018, WHITE)


def _swirl(image: np.ndarray) -> None:
    """Draw a bowl of pudding onto a label."""
    paint.dot(image, 0.5, 0.68, 0.19, (240, 232, 216))
    for radius in (0.16, 0.11, 0.06):
        paint.dot(image, 0.5, 0.68, radius, (116, 66, 40))
        paint.dot(image, 0.5 + radius * 0.1, 0.68 - radius * 0.15, radius * 0.82, (150, 96, 62))


def _cherries(image: np.ndarray) -> None:
    """Draw cherries onto a label."""
    for x, y in ((0.36, 0.7), (0.6, 0.74), (0.48, 0.64)):
        paint.dot(image, x, y, 0.13, (140, 10, 40))
        paint.dot(image, x - 0.035, y - 0.045, 0.03, (250, 170, 190))
    paint.dot(image, 0.72, 0.54, 0.06, (60, 140, 60))


def _slices(image: np.ndarray) -> None:
    """Draw slices of meat onto a label."""
    paint.fill(image, (0.0, 0.5, 1.0, 0.84), (250, 202, 40))
    for x in (0.26, 0.42, 0.58, 0.74):
        paint.dot(image, x, 0.67, 0.15, (150, 60, 56))
        paint.dot(image, x, 0.67, 0.13, (226, 138, 128))
        paint.dot(image, x + 0.02, 0.65, 0.05, (240, 186, 176))


def _bubbles(image: np.ndarray) -> None:
    """Draw bubbles onto a label."""
    for x, y, radius in ((0.3, 0.6, 0.08), (0.5, 0.72, 0.13), (0.72, 0.6, 0.1), (0.66, 0.8, 0.05), (0.28, 0.78, 0.06)):
        paint.dot(image, x, y, radius, (170, 214, 246))
        paint.dot(image, x, y, radius * 0.86, (70, 146, 220))
        paint.dot(image, x - radius * 0.25, y - radius * 0.3, radius * 0.25, WHITE)
