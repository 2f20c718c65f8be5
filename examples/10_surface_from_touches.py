"""Surface reconstruction: a hidden object's surface from touches chosen by expected error reduction.

python examples/10_surface_from_touches.py   (needs scikit-image)
"""

import jax
import jax.numpy as jnp
import numpy as np

import i2t
from i2t.objects import random_object
from i2t.reconstruction.evidence import contact_evidence
from i2t.reconstruction.exploration import AROUND_LIMITS, ExplorationConfig, choose_touch
from i2t.reconstruction.surface import SurfaceConfig, estimate_surface, init, surface_model, update
from i2t.simulation.sites import press_along


def main(touches: int = 12, known: int = 20, across: int = 32) -> i2t.Mesh:
    """Touch an object of which only others of its family are known, and return its reconstructed mesh."""
    library = [random_object(seed).mesh for seed in range(1, 1 + known)]
    model = surface_model(library, config=SurfaceConfig(across=across))
    hidden = i2t.prepare_surface(random_object(0).mesh)  # your robot touches the real one
    press = jax.jit(lambda start: press_along(hidden, start, start[:3, 2], max_distance=0.11))
    config = ExplorationConfig(limits=AROUND_LIMITS)  # held in a gripper: reached from all sides

    state, _ = init(model)
    for step in range(touches):
        site = choose_touch(model, state, config=config, seed=step).T_o_t
        if site is None:  # nothing is safe
            break
        start = site @ np.block([[np.eye(3), np.array([[0], [0], [-0.1]])], [np.zeros(3), 1]])  # 0.1 m before it
        T_o_t, hit = press(jnp.asarray(start, jnp.float32))
        state, info = update(model, state, contact_evidence(T_o_t, hit=bool(hit), swept=0.1))
        print(f"touch {step + 1}: as sure as among {info.effective_shapes:.0f} shapes (simulated)")
    return estimate_surface(model, state).mesh


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
