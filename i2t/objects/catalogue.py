"""Objects to touch: the catalogue of primitives, stamps and hand tools, and random objects.

The catalogue's meshes are read from a file of this package. A primitive has the default lengths of its function in
`i2t.objects.primitives`, and a square is 50 mm wide. A stamp is a relief 3.5 mm high, within a square of 10 mm, on a
square base. A tool has the size of a real one and lies along x. Drawing random objects needs manifold3d
(extra `shapes`).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from i2t.errors import did_you_mean, require_extra
from i2t.objects.solids import Mesh, Object

# Names of the catalogue's geometric primitives, of which the first six are the paper's.
PRIMITIVES = (
    "hexagon", "parallelogram", "star", "square", "flower", "cylinder", "triangle", "pentagon", "octagon", "cross",
    "dome", "cone", "pyramid", "ellipsoid", "torus", "wedge", "stairs", "ridge",
)  # fmt: skip
# names of the catalogue's stamps, each with a raised shape
STAMPS = ("stamp-T", "stamp-circle", "stamp-angle", "stamp-triangle", "stamp-cross")
# names of the catalogue's hand tools
HAND_TOOLS = ("cutter", "screwdriver", "spanner", "hammer", "marker", "pliers", "scissors")
NAMES = PRIMITIVES + STAMPS + HAND_TOOLS  # names of all objects in the catalogue


def make_object(name: str) -> Object:
    """Load an object of the catalogue.

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
        hint = "choose one of i2t.objects.NAMES, such as hexagon or hammer, or load a mesh file"
        raise ValueError(f"no object is called {name!r}; {did_you_mean(name, NAMES, hint)}")
    with np.load(Path(__file__).with_name("catalogue.npz"), allow_pickle=False) as arrays:
        mesh = Mesh(*(arrays[f"{name}/{part}"] for part in Mesh._fields))
    family = "primitive" if name in PRIMITIVES else "stamp" if name in STAMPS else "tool"
    return Object(name, mesh, family)


def random_object(seed: int) -> Object:
    """Draw a primitive of a random family and random proportions, 50-72 mm across and up to 40 mm high.

    Args:
        seed: The seed, which determines the object.

    Returns:
        The object, named by its family and seed.

    Raises:
        MissingExtraError: manifold3d is not installed.
    """
    require_extra("manifold3d", "a random object")
    from i2t.objects.primitives import draw_random

    return draw_random(seed)


def surrogate_unknown(known_meshes: Sequence[Mesh], seed: int) -> Object:
    """Draw an object that differs from the known ones but might be mistaken for one.

    It is a random outline with the height of a known object, or a known mesh that is stretched or shrunk by 1/7 to 1/2
    along x and y. With probability 1/2 its height is changed at random as well. Many surrogates represent what an
    unknown object might be (`experiments.studies.open_set`).

    Args:
        known_meshes: Meshes of the known objects.
        seed: The seed, which together with the number of known objects determines the surrogate.

    Returns:
        The surrogate, named by its seed.
    """
    rng = np.random.default_rng([seed, len(known_meshes)])
    like = known_meshes[int(rng.integers(len(known_meshes)))]
    height = float(np.ptp(like.vertices[:, 2])) * (1.0 if rng.random() < 0.5 else np.exp(rng.uniform(-1.2, 0.3)))
    if rng.random() < 0.5:
        like = random_object(int(rng.integers(2**31))).mesh
        across = np.ones(2)
    else:
        across = np.exp(rng.choice([-1, 1], 2) * rng.uniform(0.15, 0.4, 2))
    scale = np.array([*across, height / float(np.ptp(like.vertices[:, 2]))])
    return Object(f"surrogate-{seed}", Mesh(like.vertices * scale, like.faces), "primitive")
