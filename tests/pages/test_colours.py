"""Colours of the pages: contrast by WCAG 2.1, and apart for colour-blind readers."""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest

import rig.pages

PAGES = Path(rig.pages.__file__).parent
TEXTS = ("text", "quiet", "accent", "good", "warn", "bad", "estimated", "law", "virtual", "error")
SERIES = ("measured", "estimated", "law", "virtual", "error")

# Machado, Oliveira, Fernandes, "A physiologically-based model for simulation of color vision
# deficiency", IEEE TVCG 15 (2009): severity 1, linear RGB.
DEFICIENCIES = {
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}


def colours(scheme):
    text = (PAGES / "view" / "page.css").read_text()
    blocks = re.findall(r":root(\[data-theme=\"dark\"\])? \{(.*?)\n\}", text, re.DOTALL)
    found = {}
    for dark, block in blocks:
        if not dark or scheme == "dark":
            found |= dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", block))
    return found


def linear(colour):
    srgb = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def contrast(one, other):
    light, dark = sorted(
        (float(linear(it) @ (0.2126, 0.7152, 0.0722)) for it in (one, other)), reverse=True
    )
    return (light + 0.05) / (dark + 0.05)


def lab(rgb):
    """CIELAB of linear sRGB under D65."""
    matrix = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    xyz = np.array(matrix) @ np.clip(rgb, 0.0, 1.0) / (0.9505, 1.0, 1.089)
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_text_and_curve_has_contrast_on_every_ground(scheme):
    found = colours(scheme)
    for name, ground in itertools.product(TEXTS, ("card", "page")):
        assert contrast(found[name], found[ground]) >= 4.5, (name, ground)
    for tone in ("good", "part", "bad", "wait", "idle"):
        assert contrast(found[f"band-{tone}"], "#ffffff") >= 4.5, tone


@pytest.mark.parametrize("deficiency", DEFICIENCIES)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_all_series_stay_apart_for_the_colour_blind(scheme, deficiency):
    """A difference of 10 in CIELAB is seen at a glance; curves of one chart differ in dash, too."""
    found, matrix = colours(scheme), np.array(DEFICIENCIES[deficiency])
    seen = {name: lab(matrix @ linear(found[name])) for name in SERIES}
    for one, other in itertools.combinations(SERIES, 2):
        assert np.linalg.norm(seen[one] - seen[other]) > 10.0, (one, other)
