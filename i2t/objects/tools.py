"""Hand tools of about real size, lying on the table: unions of turned, extruded and bent round parts, in millimetres.

Lengths follow common catalogue sizes: an 18 mm snap-off cutter, a slotted screwdriver of 6 x 100 mm, an open spanner
for 17 and 19 mm, a claw hammer of 280 mm, a board marker, combination pliers of 180 mm and household scissors. The
long axis is x; z is up from the table, wherever each drawing has its origin.
"""

from collections.abc import Callable

import numpy as np
from manifold3d import CrossSection, Manifold

from i2t.objects.drawing import Real, box, chain, disk, outline, polar, prism, rectangle, rounded, turned


def cutter() -> Manifold:
    """A snap-off cutter with its blade out: a body with a groove, a ribbed slider in it, an oblique blade."""
    side = outline([(-82, -8), (-74, -12), (45, -12), (66, -7), (66, 8), (56, 11), (-76, 12), (-82, 8)])
    body = prism(rounded(side, 3.0), 14.0) - box((98, 6, 6), (5, 0, 14))
    slider = box((24, 9, 8), (28, 0, 14))
    for x in (19, 23, 27, 31, 35):
        slider += box((1.6, 9, 2), (x, 0, 18))
    blade = prism(outline([(40, -5), (88, -5), (101, 5), (40, 5)]), 0.6, 6.7)
    return body + slider + blade


def screwdriver() -> Manifold:
    """A slotted screwdriver: fluted handle with a rounded end, collar, round shaft, flat tip."""
    angles = 2 * np.pi * np.arange(96) / 96
    flutes = prism(polar(14 + 1.0 * np.cos(6 * angles)), 100.0).rotate((0, 90, 0))
    envelope = turned([(0, 4), (3, 10), (8, 13.5), (14, 15), (66, 15), (78, 11), (84, 9.5), (92, 10.5), (100, 9)])
    shaft = turned([(95, 3), (190, 3)])
    tip = Manifold.batch_hull([turned([(182, 3), (184, 3)]), box((1, 0.9, 6.5), (199.5, 0, 0))])
    return (flutes ^ envelope) + shaft + tip


def spanner() -> Manifold:
    """A double open spanner: two jaws turned by 15 degrees, a thinner shank."""

    def head(size: Real, x: Real, angle: Real) -> CrossSection:
        jaw = rectangle(2.2 * size, size, (1.1 * size, 0)) + disk(size / 2, (0, 0))
        whole = disk(1.05 * size) - jaw.translate((-0.1 * size, 0))
        return whole.rotate(angle).translate((x, 0))

    heads = rounded(head(19, 85, 15) + head(17, -85, 195), 1.0)
    shank = rounded(outline([(-75, -6.5), (75, -7.5), (75, 7.5), (-75, 6.5)]), 1.0)
    shank -= disk(1.05 * 19 - 1, (85, 0)) + disk(1.05 * 17 - 1, (-85, 0))
    return prism(heads, 9.0) + prism(shank, 5.0, 2.0)


def hammer() -> Manifold:
    """A claw hammer on its side: striking face towards +y, claw towards -y, handle along -x."""
    striker = turned([(0, 9), (14, 8), (22, 8), (24, 12), (26, 13), (38, 13), (40, 12)]).rotate((0, 0, 90))
    block = box((26, 34, 24), (0, -5, 0))
    curve = outline([(13, -20), (10, -38), (2, -56), (-14, -74), (-16, -72), (-10, -54), (-9, -38), (-13, -20)])
    claw = prism(curve, 22.0, -11.0)
    slot = prism(outline([(-30, 1.2), (-80, 4.5), (-80, -4.5), (-30, -1.2)]), 60.0, -30.0)  # (y, z), extruded along x
    slot = slot.rotate((90, 0, 90))
    x = (0, -40, -120, -190, -240, -262)
    grip = chain([(a, 0, 0) for a in x], (8.0, 8.0, 9.5, 12.0, 13.0, 11.0)).scale((1, 1.25, 0.85))
    return striker.translate((0, 8, 0)) + block + (claw - slot) + grip


def marker() -> Manifold:
    """A capped board marker: plug, barrel, cap with a clip."""
    barrel = turned(
        [(0, 5.5), (1, 6.5), (7, 6.5), (8, 8), (9, 8.5), (92, 8.5), (92, 9.2), (118, 9.2), (131, 8), (133, 6)]
    )
    clip = box((30, 4, 2.0), (112, 0, 11.2)) + box((5, 4, 5), (124, 0, 9.5))
    return barrel + clip.rotate((90, 0, 0))  # it rests on its barrel with the clip to the side


def pliers() -> Manifold:
    """Combination pliers, closed: two tapered jaws with a wire hole, a pivot with a rivet, two bent handles."""
    jaw = outline([(-4, 0.2), (-10, 12), (8, 13), (28, 8), (52, 4.5), (54, 0.2)]) - disk(3.5, (26, 0))
    cheek = prism(jaw, 10.0, -5.0)
    grip = chain(
        [(-4, 9, 0), (-22, 12, 0), (-50, 21, 0), (-85, 24, 0), (-115, 20, 0), (-128, 22, 0)],
        (5.0, 5.0, 6.0, 6.5, 6.5, 6.0),
    )
    half = cheek + grip
    pivot = prism(disk(14.0), 11.0, -5.5) + prism(disk(5.0), 14.0, -7.0)
    return half + half.mirror((0, 1, 0)) + pivot


def scissors() -> Manifold:
    """Closed household scissors: two blades one over the other, a screw, two oval bows."""
    blade = outline([(-25, -4), (-12, -8), (15, -8.5), (95, -2), (97, 0), (90, 3.0), (10, 6), (-20, 5)])
    angles = np.linspace(0, 2 * np.pi, 13)

    def bow(length: Real, width: Real) -> Manifold:
        ring = [(-68 + length * np.cos(a), 22 + width * np.sin(a), 0) for a in angles]
        return chain(ring, [4.5] * len(ring)) + chain([(-20, 1, 0), (-32, 6, 0), (-44, 12, 0)], (4.0, 4.2, 4.5))

    lower = prism(blade, 2.2, -2.2) + bow(26, 14)
    upper = prism(blade.mirror((0, 1)), 2.2, 0.0) + bow(22, 13).mirror((0, 1, 0))
    return lower + upper + prism(disk(4.5), 7.0, -3.5)


TOOLS: dict[str, Callable[[], Manifold]] = {
    f.__name__: f for f in (cutter, screwdriver, spanner, hammer, marker, pliers, scissors)
}
