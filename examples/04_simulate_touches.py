"""Touches in bulk: objects, a random skin and the errors of a lab become a data set on disk.

python examples/04_simulate_touches.py
"""

import jax
import numpy as np

import i2t


def main(path: str = "runs/touches.h5", n: int = 36) -> i2t.Dataset:
    """Simulate n touches of each of two objects, write them, read them back, and return them."""
    names = ("hexagon", "star")
    surfaces = [i2t.prepare_surface(i2t.make_object(name).mesh) for name in names]
    pad = i2t.sample_pad(jax.random.key(0))  # every skin is different
    touches = i2t.simulate_touches(jax.random.key(1), surfaces, pad, i2t.SimulationErrors(), n)

    i2t.save_dataset(path, i2t.Dataset.simulated(touches, names, pad))  # in sessions, each with an object placed anew
    dataset = i2t.load_dataset(path)
    size = np.linalg.norm(dataset.touches.reading, axis=1)
    print(f"{len(dataset)} touches (simulated) in {path}; a reading changes by {np.median(size):.0f} uT (norm, median)")
    return dataset


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
