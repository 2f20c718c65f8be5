"""Figures can be read by colour-blind readers: their colours stay apart, and they take no others.

Colours are seen as by Machado, Oliveira and Fernandes, "A physiologically-based model for simulation of color vision
deficiency", 2009 (whole deficiency), and differ by CIEDE2000, where 2 is just seen and 10 at a glance.
"""

import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from skimage.color import deltaE_ciede2000, rgb2lab

from i2t.viz.style import CURVE_COLOURS

ROOT = Path(__file__).parents[2]
CODE = [path for folder in ("i2t", "experiments") for path in sorted((ROOT / folder).rglob("*.py"))]
APART = 10.0  # CIEDE2000
SEEN_BY = {
    "all cones": np.eye(3),
    "no red cones": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "no green cones": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "no blue cones": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
SEQUENTIAL = {"cividis", "cividis_r", "viridis", "gray", "Greys", "Blues"}
DIVERGING = {"PuOr", "RdBu"}
CMAP = re.compile(r"cmap=\"(\w+)\"|colormaps\[\"(\w+)\"\]")
HEX = re.compile(r"#[0-9A-Fa-f]{6}\b")


def _seen(colours, by):
    """CIE Lab values (n, 3) of colours as seen with different colour vision."""
    rgb = np.array([to_rgb(colour) for colour in colours])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.asarray(SEEN_BY[by]).T, 0, 1)
    return rgb2lab(np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055)[None])[0]


def _least_difference(colours, by):
    lab = _seen(colours, by)
    return min(float(deltaE_ciede2000(lab[i], lab[j])) for i, j in combinations(range(len(lab)), 2))


@pytest.mark.parametrize("by", SEEN_BY)
def test_colours_of_the_palette_stay_apart(by):
    assert _least_difference(CURVE_COLOURS, by) > APART


@pytest.mark.parametrize("by", SEEN_BY)
@pytest.mark.parametrize("name", sorted(SEQUENTIAL | DIVERGING))
def test_a_colour_map_can_be_ordered_by_its_lightness(name, by):
    """From end to end, or from the middle to two ends that stay apart."""
    lab = _seen(colormaps[name](np.linspace(0, 1, 33)), by)
    halves = [lab[:17], lab[16:]] if name in DIVERGING else [lab]
    for half in halves:
        steps = np.diff(half[:, 0])
        assert (np.sign(steps) == np.sign(steps.sum())).all()
    assert float(deltaE_ciede2000(lab[0], lab[-1])) > 2 * APART


def test_other_colours_are_grey_or_all_but_black_or_white():
    """Every other colour is one of the palette, by its name, or from these maps."""
    style = ROOT / "i2t" / "viz" / "style.py"
    wrong, maps = [], set()
    for path in CODE:
        maps |= {one or other for one, other in CMAP.findall(path.read_text())}
        for colour in HEX.findall(path.read_text()) if path != style else ():
            lightness, a, b = _seen([colour], "all cones")[0]
            if np.hypot(a, b) > 3 and 10 < lightness < 90 and colour not in CURVE_COLOURS:
                wrong.append((path.name, colour))
    assert wrong == []
    assert maps
    assert maps <= SEQUENTIAL | DIVERGING
