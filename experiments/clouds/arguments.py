"""The options of `python -m experiments.clouds`, without JAX."""

from dataclasses import dataclass
from pathlib import Path

from i2t.cli import Count, NotNegative, Positive, Seed


@dataclass(frozen=True)
class CloudArgs:
    """Compare disks on sampled points with the mesh they were sampled from."""

    out: Path | None = None  # folder for clouds.json
    shapes: tuple[str, ...] = ("dome", "stairs", "screwdriver")  # of the catalogue
    spacings: tuple[Positive, ...] = (0.5e-3, 1e-3, 2e-3)  # m, mean distance of neighbours: area = points x spacing^2
    noises: tuple[NotNegative, ...] = (0.0, 0.3e-3)  # m, standard deviation along the normal
    sites: Count = 40  # on each shape
    seed: Seed = 0

    def check(self) -> None:
        """Refuse shapes that the catalogue does not have."""
        from i2t.objects.catalogue import NAMES

        if unknown := [name for name in self.shapes if name not in NAMES]:
            raise ValueError(f"--shapes {unknown[0]}: is no object of the catalogue, which has {', '.join(NAMES)}")
