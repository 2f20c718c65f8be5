"""Reconstruct the surface of a hidden object from touches chosen by expected error reduction.

python examples/10_surface_from_touches.py   (needs scikit-image)
"""

import jax
import jax.numpy as jnp

import i2t
from i2t.contact.approach import first_contact
from i2t.objects import random_object
from i2t.reconstruction.evidence import contact_evidence
from i2t.reconstruction.exploration import AROUND_LIMITS, ExplorationConfig, choose_touch
from i2t.reconstruction.surface import SurfaceConfig, estimate_surface, init, surface_model, update


def main(touches: int = 12, library_size: int = 20, across: int = 32) -> i2t.Mesh:
    """Touch an unknown object, with a library of others of its family, and return the reconstructed mesh."""
    library = [random_object(seed).mesh for seed in range(1, 1 + library_size)]
    model = surface_model(library, config=SurfaceConfig(across=across))
    hidden = i2t.prepare_surface(random_object(0).mesh)  # your robot touches a real object
    press = jax.jit(lambda site: first_contact(hidden, site, before=0.1, beyond=0.01))
    config = ExplorationConfig(limits=AROUND_LIMITS)  # held in a gripper, reachable from all sides

    state, _ = init(model)
    for step in range(touches):
        site = choose_touch(model, state, config=config, seed=step).T_o_t
        if site is None:  # no site is safe
            break
        contact = press(jnp.asarray(site, jnp.float32))
        state, info = update(model, state, contact_evidence(contact.T_w_t, hit=bool(contact.hit), swept=0.1))
        print(f"touch {step + 1}: effective number of shapes {info.effective_shapes:.0f} (simulated)")
    return estimate_surface(model, state).mesh


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
