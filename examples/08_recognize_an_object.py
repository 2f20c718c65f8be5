"""Recognise an object with a pad model fitted to other objects and touches chosen from the belief.

python examples/08_recognize_an_object.py
"""

import jax

import i2t


def main(training_touches: int = 48, config: i2t.RecognizerConfig | None = None) -> str | None:
    """Fit a pad model to touches of a hexagon, recognise a hidden object among three, and return its name."""
    pad, errors, limits = i2t.sample_pad(jax.random.key(0)), i2t.SimulationErrors(), i2t.PressLimits()
    hexagon = i2t.prepare_surface(i2t.make_object("hexagon").mesh)
    touches = i2t.simulate_touches(
        jax.random.key(1), [hexagon], pad, errors, training_touches, touches_per_session=training_touches // 2
    )
    fitted = i2t.fit_pad_model(i2t.Dataset.simulated(touches, ("hexagon",), pad), key=jax.random.key(2))

    meshes = {name: i2t.make_object(name).mesh for name in ("star", "cylinder", "hammer")}
    config = config or i2t.RecognizerConfig(num_sites=12, num_particles=32)  # half of the default, to start sooner
    recognizer = i2t.ObjectRecognizer(jax.random.key(3), fitted.model, meshes, config=config)
    hidden = i2t.prepare_surface(meshes["cylinder"])  # your robot touches a real object
    touch = i2t.simulation.touch_simulator(jax.random.key(4), hidden, pad, errors=errors, limits=limits)
    state, info = recognizer.init(), None
    while (site := recognizer.choose_touch(state)) is not None:
        result = touch(site.T_w_t)
        contact = int(result.code) != i2t.ReturnCode.AIR
        observation = recognizer.observe(
            site, result.reading, force=float(result.force), T_w_t=result.T_w_t, contact=contact
        )
        state, info = recognizer.update(state, observation)
        print(f"touch {state.touches}: {info.name} with probability {info.confidence:.2f} (simulated)")
    return info.name if info else None


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
