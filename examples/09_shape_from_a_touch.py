"""Local shape: presses with two stops, and a posterior over the surface that each met.

python examples/09_shape_from_a_touch.py
"""

from functools import partial

import jax
import numpy as np

import i2t
from i2t.reconstruction import build_library, imagine_presses, infer_patch, sample_contacts
from i2t.runtime.compiling import jit_quickly

KNOWN = ("square", "cylinder", "cross", "stamp-T")  # shapes of the library; the star is none of them


def main(patches: int = 512, presses: int = 16) -> tuple[float, float]:
    """Press a star and infer what was met: mean error (mm) of the depth after a press, and before it."""
    pad = i2t.sample_pad(jax.random.key(1))
    library = build_library(jax.random.key(2), [i2t.prepare_surface(i2t.make_object(n).mesh) for n in KNOWN], patches)
    model = imagine_presses(pad, library)  # what this skin would read at each patch of the library

    star = i2t.prepare_surface(i2t.make_object("star").mesh)
    contacts, _ = sample_contacts(jax.random.key(3), [star], presses)
    curve = jit_quickly(
        partial(i2t.simulation.simulate_press_curve, errors=i2t.SimulationErrors(), limits=i2t.PressLimits())
    )
    infer = jit_quickly(infer_patch, static_argnames=("samples",))
    before = np.mean(library.patch, axis=0, dtype=np.float32)
    errors = []
    for key, heights, met in zip(
        jax.random.split(jax.random.key(4), presses), contacts.height, contacts.patch, strict=True
    ):
        press = curve(key, pad, heights)
        posterior = infer(press.reading, press.force, press.travel, model=model, library=library)
        errors.append([np.mean(np.abs(depth - met)) for depth in (posterior.mean, before)])
    wrong, wrong_before = (float(1e3 * each) for each in np.mean(errors, axis=0))
    print(f"depth wrong by {wrong:.2f} mm, before the press by {wrong_before:.2f} mm ({presses} presses, simulated)")
    return wrong, wrong_before


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
