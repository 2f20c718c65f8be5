"""Infer the surface below single presses with two stops.

python examples/09_shape_from_a_touch.py
"""

from functools import partial

import jax
import numpy as np

import i2t
from i2t.reconstruction import build_library, infer_patch, predict_presses, sample_contacts
from i2t.runtime.compiling import jit_quickly


def main(patches: int = 512, presses: int = 16) -> tuple[float, float]:
    """Press a star and infer the surface; return the mean error (mm) of the depth after a press and before it."""
    pad = i2t.sample_pad(jax.random.key(1))
    shapes = [i2t.make_object(name).mesh for name in ("square", "cylinder", "cross", "stamp-T")]  # without the star
    library = build_library(jax.random.key(2), list(map(i2t.prepare_surface, shapes)), patches)
    model = predict_presses(pad, library)  # predicted readings at each patch of the library

    star = i2t.prepare_surface(i2t.make_object("star").mesh)
    contacts, _ = sample_contacts(jax.random.key(3), [star], presses)
    curve = jit_quickly(
        partial(i2t.simulation.simulate_press_curve, errors=i2t.SimulationErrors(), limits=i2t.PressLimits())
    )
    infer = jit_quickly(infer_patch, static_argnames=("samples",))
    before = np.mean(library.patch, axis=0, dtype=np.float32)
    errors = []
    for key, heights, true in zip(
        jax.random.split(jax.random.key(4), presses), contacts.height, contacts.patch, strict=True
    ):
        press = curve(key, pad, heights)
        posterior = infer(press.reading, press.force, press.travel, model=model, library=library)
        errors.append([np.mean(np.abs(depth - true)) for depth in (posterior.mean, before)])
    after_mm, before_mm = (float(1e3 * error) for error in np.mean(errors, axis=0))
    print(f"error of the depth: {after_mm:.2f} mm, before the press {before_mm:.2f} mm ({presses} presses, simulated)")
    return after_mm, before_mm


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
