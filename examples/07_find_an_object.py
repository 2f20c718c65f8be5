"""Correct the nominal pose of a known mesh from a few touches at known tool poses.

python examples/07_find_an_object.py
"""

import jax
import numpy as np

import i2t
from i2t.geometry import exp
from i2t.registration import contact_poses


def main(n: int = 24) -> tuple[float, float]:
    """Touch a hammer that is displaced by 3 mm and 3 degrees; return the position errors (m) before and after."""
    surface = i2t.prepare_surface(i2t.make_object("hammer").mesh)
    errors = i2t.SimulationErrors(placement=0.0, placement_angle=0.0)
    touches = i2t.simulate_touches(jax.random.key(0), [surface], i2t.sample_pad(jax.random.key(1)), errors, n)

    # The simulated object is at the world's origin, and its nominal pose is elsewhere.
    T_w_nominal = np.asarray(exp(np.array([2e-3, -2e-3, 1e-3, 0.0, 0.0, np.radians(3.0)])), np.float32)
    T_w_contact, met = contact_poses(touches)
    estimate = i2t.register_by_touch(
        jax.random.key(2), surface, T_w_nominal, T_w_contact, met,
        translation_std=3e-3, rotation_std=np.radians(3.0),
    )  # fmt: skip
    before, after = (float(np.linalg.norm(np.asarray(T)[:3, 3])) for T in (T_w_nominal, estimate.T_w_o))
    print(f"{n} touches (simulated): position error {1e3 * before:.2f} mm before, {1e3 * after:.2f} mm after")
    return before, after


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
