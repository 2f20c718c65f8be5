"""The study of the belief's constants: what it calls better."""

import numpy as np

from experiments.studies import constants

EPISODES, TOUCHES, OBJECTS = 300, 4, 3
RNG = np.random.default_rng(0)
TRUTH = RNG.integers(OBJECTS, size=EPISODES)


def beliefs(strength: float, sharpness: float = 1.0) -> np.ndarray:
    """Beliefs (e, t, objects) from noisy evidence for the truth; sharper ones are more certain than they should be."""
    rng = np.random.default_rng(1)
    evidence = rng.normal(size=(EPISODES, TOUCHES, OBJECTS))
    evidence[np.arange(EPISODES), :, TRUTH] += strength
    logits = sharpness * strength * np.cumsum(evidence, axis=1)
    p = np.exp(logits - logits.max(-1, keepdims=True))
    return p / p.sum(-1, keepdims=True)


def test_more_evidence_is_better_and_more_certainty_is_not(capsys):
    tried = {constants.IN_USE: beliefs(1.0), "more evidence": beliefs(1.5), "overconfident": beliefs(1.0, 3.0)}
    found = constants.report_kind("likelihood", tried, TRUTH, ())
    assert found["more evidence"]["lower_by"]["low"] > 0.02
    assert abs(found["overconfident"]["lower_by"]["mean"]) < 0.01  # its own temperature undoes it
    shown = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in shown if "BETTER" in line] == ["more"]
