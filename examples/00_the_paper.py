"""Imagine2touch in one page, simulated: touch two objects, learn to imagine touches, recognise others by them.

python examples/00_the_paper.py
"""

import jax

import i2t

TRAINING, TOOL, UNSEEN = ("hexagon", "parallelogram"), "cutter", ("star", "square", "cylinder")


def main(touches: int = 468, epochs: int = 60, episodes: int = 24, count: int = 10) -> dict[str, float]:
    """Run the paper's experiment; return the share of episodes in which each method recognises the object."""
    key_touch, key_fit, *_ = keys = jax.random.split(jax.random.key(0), 5)
    pad, errors, limits = i2t.nominal_pad(), i2t.SimulationErrors(), i2t.PressLimits()

    # Touch two objects to learn from, and a tool to choose the best epoch by, at random places in sessions of 36.
    names = (*TRAINING, TOOL)
    surfaces = i2t.prepare_surfaces([i2t.make_object(name).mesh for name in names])
    touched = i2t.simulate_touches(key_touch, surfaces, pad, errors, touches, touches_per_session=36, limits=limits)
    dataset = i2t.Dataset.simulated(touched, names, pad)
    split = i2t.Split.hold_out(dataset, "object", validation=[TOOL])

    # Learn tau~ = f(patch): 48 x 48 -> 200 -> 5 -> 500 -> 15, with the decoded patch as a second task.
    training = i2t.TrainConfig(epochs=epochs, batch_size=32)
    predictor = i2t.fit_predictor(dataset, split, method="paper-depth", key=key_fit, training=training)
    tau = dataset.touches.reading[split.validation]
    predicted = predictor.predict(dataset.touches.patch[split.validation]).mean
    explained = 1 - ((predicted - tau) ** 2).sum() / ((tau - tau.mean(0)) ** 2).sum()
    print(f"touches of the {TOOL}, which was not learned from: R2 {explained:.2f} (simulated)")

    # Recognise objects never touched before: sample a hypothesis, touch where it differs from the others, and let the
    # touch vote. Proprioception, the baseline, compares only where the contact was.
    surfaces = i2t.prepare_surfaces([i2t.make_object(name).mesh for name in UNSEEN])
    results = i2t.run_paper_loop(
        keys[2:], {"Imagine2touch": predictor}, dict(zip(UNSEEN, surfaces, strict=True)), pad,
        reading_std=dataset.touches.reading[split.train].std(0), episodes=episodes, touches=count,
        errors=errors, limits=limits,
    )  # fmt: skip
    right = {method: float(result.hits()[:, -1].mean()) for method, result in results.items()}
    for method, share in right.items():
        chance = f"chance {1 / len(UNSEEN):.0%}; simulated"
        print(f"{method} recognised {share:.0%} of {episodes} after {count} touches ({chance})")
    return right


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
