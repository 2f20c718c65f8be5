"""Simulate a data set of touches with a random skin and the errors of a lab.

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

    i2t.save_dataset(path, i2t.Dataset.simulated(touches, names, pad))  # the object is placed anew in each session
    dataset = i2t.load_dataset(path)
    size = np.linalg.norm(dataset.touches.reading, axis=1)
    print(f"{len(dataset)} touches (simulated) in {path}; median magnitude of a reading: {np.median(size):.0f} uT")
    return dataset


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
