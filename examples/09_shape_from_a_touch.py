"""Local shape: one press with two stops, and a posterior over the surface that it met.

python examples/09_shape_from_a_touch.py
"""

import jax
import numpy as np

import i2t
from i2t.reconstruction import build_library, imagine_presses, infer_patch, sample_contacts, simulate_press_curve
from i2t.simulation.press import PressLimits
from i2t.simulation.touches import SimulationErrors

KNOWN = ("square", "cylinder", "cross", "stamp-T")  # shapes of the library; the star is none of them


def main(patches: int = 512) -> tuple[float, float]:
    """Press a star and infer what was met: mean error (mm) of the depth after the press, and before it."""
    pad = i2t.sample_pad(jax.random.key(1))
    library = build_library(jax.random.key(2), [i2t.prepare_surface(i2t.make_object(n).mesh) for n in KNOWN], patches)
    model = imagine_presses(pad, library)  # what this skin would read at each patch of the library

    star = i2t.prepare_surface(i2t.make_object("star").mesh)
    contacts, _ = sample_contacts(jax.random.key(3), [star], 1)
    curve = jax.jit(simulate_press_curve, static_argnames=("errors", "limits"))
    press = curve(jax.random.key(4), pad, contacts.height[0], errors=SimulationErrors(), limits=PressLimits())

    infer = jax.jit(infer_patch, static_argnames=("samples",))
    posterior = infer(press.reading, press.force, press.travel, model=model, library=library)
    after, before = (
        float(1e3 * np.mean(np.abs(np.asarray(depth, np.float32) - contacts.patch[0])))
        for depth in (posterior.mean, np.mean(library.patch, axis=0, dtype=np.float32))
    )
    print(f"{press.force[-1]:.1f} N: depth wrong by {after:.2f} mm, before the press by {before:.2f} mm (simulated)")
    return after, before


if __name__ == "__main__":
    main()
