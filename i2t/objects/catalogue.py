"""Things to touch: the catalogue of primitives, stamps and hand tools, and random objects.

The catalogue's meshes are read from a file of this package. A primitive has the lengths that its function in
`i2t.objects.primitives` has by default, a square is 50 mm wide; a stamp is a relief 3.5 mm high, inside a square of
10 mm, on a square base; a tool is of a real one's size and lies along x. What draws random objects needs manifold3d
(`pip install "imagine2touch[shapes]"`).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from i2t.errors import did_you_mean, require_extra
from i2t.objects.solids import Mesh, Object

PRIMITIVES = (  # the paper's six first
    "hexagon", "parallelogram", "star", "square", "flower", "cylinder", "triangle", "pentagon", "octagon", "cross",
    "dome", "cone", "pyramid", "ellipsoid", "torus", "wedge", "stairs", "ridge",
)  # fmt: skip
STAMPS = ("stamp-T", "stamp-circle", "stamp-angle", "stamp-triangle", "stamp-cross")
TOOLS = ("cutter", "screwdriver", "spanner", "hammer", "marker", "pliers", "scissors")
NAMES = PRIMITIVES + STAMPS + TOOLS
MESHES = Path(__file__).with_name("catalogue.npz")


def make_object(name: str) -> Object:
    """One object of the catalogue.

    Args:
        name: One of `NAMES`.

    Returns:
        The object, standing on z = 0 of its own frame.

    Raises:
        ValueError: The name is not in the catalogue.

    Example:
        mesh = i2t.make_object("hammer").mesh
    """
    if name not in NAMES:
        otherwise = "choose one of i2t.objects.NAMES, such as hexagon or hammer, or load a mesh file"
        remedy = did_you_mean(name, NAMES, otherwise)
        raise ValueError(f"no object is called {name!r}; {remedy}")
    with np.load(MESHES, allow_pickle=False) as arrays:
        mesh = Mesh(*(arrays[f"{name}/{part}"] for part in Mesh._fields))
    family = "primitive" if name in PRIMITIVES else "stamp" if name in STAMPS else "tool"
    return Object(name, mesh, family)


def random_object(seed: int) -> Object:
    """Draw a primitive of a random family and proportions, 50-72 mm across, up to 40 mm high.

    Args:
        seed: One seed, one object.

    Returns:
        The object, named by its family and seed.

    Raises:
        MissingExtraError: manifold3d is missing.
    """
    require_extra("manifold3d", "a random object")
    from i2t.objects.primitives import draw_random

    return draw_random(seed)


def surrogate_unknown(known: Sequence[Mesh], seed: int) -> Object:
    """Draw an object that is none of the known ones but might be taken for one.

    It has a known object's height with a random outline, or is a known mesh stretched or shrunk by 1/7 to 1/2 along x
    and y; with probability 1/2 the height is drawn instead. Many of them stand for what an unknown object might be
    (`experiments.studies.open_set`).

    Args:
        known: Meshes of the known objects.
        seed: One seed and number of known objects, one surrogate.

    Returns:
        The surrogate.
    """
    rng = np.random.default_rng([seed, len(known)])
    like = known[int(rng.integers(len(known)))]
    height = float(np.ptp(like.vertices[:, 2])) * (1.0 if rng.random() < 0.5 else np.exp(rng.uniform(-1.2, 0.3)))
    if rng.random() < 0.5:
        like = random_object(int(rng.integers(2**31))).mesh
        across = np.ones(2)
    else:
        across = np.exp(rng.choice([-1, 1], 2) * rng.uniform(0.15, 0.4, 2))
    scale = np.array([*across, height / float(np.ptp(like.vertices[:, 2]))])
    return Object(f"surrogate-{seed}", Mesh(like.vertices * scale, like.faces), "primitive")
