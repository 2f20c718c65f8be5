"""Predict the reading of a touch, with its uncertainty, from a mesh and a pose.

python examples/05_predict_a_touch.py

The ready model is of one simulated pad; pass "runs/train" to `main` for your own run.
"""

import numpy as np

import i2t


def main(run: str = "nominal") -> i2t.Reading:
    """Predict presses of 1 N at four sites of a screwdriver, and return the last reading."""
    predictor = i2t.load_predictor(run)
    mesh = i2t.make_object("screwdriver").mesh  # not in the training set
    sites = i2t.sample_touch_sites(mesh, 4, seed=0)  # safe sites for the skin

    for T_o_t in sites.T_o_t:
        reading = predictor.predict_touch(mesh, T_o_t, force=1.0)
        strongest = int(np.argmax(np.abs(reading.mean)))
        chip, axis = divmod(strongest, 3)
        print(
            f"at {1e3 * T_o_t[:3, 3].round(4)} mm: chip {chip} {'xyz'[axis]} changes most, "
            f"by {reading.mean[strongest]:.1f} +- {reading.std[strongest]:.1f} uT"
        )
    return reading


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
