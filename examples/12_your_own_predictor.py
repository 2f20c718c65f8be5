"""Write your own predictor in one file; train, compare, save and load it as those of i2t.

python examples/12_your_own_predictor.py
python -m experiments.train --method examples.12_your_own_predictor:Slopes
"""

from dataclasses import dataclass

import jax
import numpy as np

import i2t


@dataclass(frozen=True)
class SlopeModel(i2t.TouchModel):
    """A linear function of a patch's slopes, spread and near fraction; its fields are saved."""

    weights: np.ndarray  # (5, c) uT
    spread: np.ndarray  # (c,) uT, standard deviation of the errors

    @property
    def channels(self) -> int:
        """Number of values of a reading."""
        return len(self.spread)

    def predict_batch(self, touches: i2t.prediction.TouchBatch) -> i2t.Reading:
        """Predict n touches; `touches` also contains force and travel if measured."""
        mean = features(touches.patch) @ self.weights
        return i2t.Reading(mean, np.broadcast_to(self.spread, mean.shape))


def features(patch: np.ndarray) -> np.ndarray:
    """Features (n, 5), each of order one, of patches (n, p, p) in metres."""
    rows, columns = patch.mean(2), patch.mean(1)
    near = (patch < 0.5e-3).mean((1, 2))
    slope = [1e3 * (line[:, -1] - line[:, 0]) for line in (rows, columns)]
    return np.stack([np.ones(len(patch)), near, *slope, 1e3 * patch.std((1, 2))], 1)


class Slopes(i2t.Method):
    """Least squares on the training touches."""

    title = "least squares on slopes"

    def fit(self, key: jax.Array, touches: i2t.prediction.TrainingTouches, split: i2t.Split) -> i2t.Predictor:
        """Fit to the training touches; a method with its own validation uses `split.validation`."""
        seen = touches.dataset.touches
        x, y = features(seen.patch[split.train]), seen.reading[split.train]
        weights = np.linalg.lstsq(x, y)[0]
        spread = (y - x @ weights).std(0) + 1e-6
        return touches.predictor(SlopeModel(np.float32(weights), np.float32(spread)), split)


def main(out: str = "runs/slopes", n: int = 72) -> i2t.Predictor:
    """Fit the model to simulated touches, save it, load it, and return it."""
    surface, pad = i2t.prepare_surface(i2t.make_object("hexagon").mesh), i2t.nominal_pad()
    touches = i2t.simulate_touches(jax.random.key(0), [surface], pad, i2t.SimulationErrors(), n)
    dataset, rows = i2t.Dataset.simulated(touches, ("hexagon",), pad), np.arange(n) < n * 2 // 3
    split = i2t.Split(rows, ~rows, ~rows, dataset.touches.session, "time")
    i2t.fit_predictor(dataset, split, method=Slopes()).save(out)
    predictor = i2t.load_predictor(out)
    error = predictor.predict(dataset.touches.patch[~rows]).mean - dataset.touches.reading[~rows]
    print(f"RMS error {np.sqrt((error**2).mean()):.0f} uT on the last {(~rows).sum()} (simulated)")
    return predictor


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
