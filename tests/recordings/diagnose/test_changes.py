"""Faults of recorded presses are found, and sound presses raise no alarm."""

import numpy as np

from i2t.recordings.diagnose import check_presses, repeated_rows

CHANNELS = 15


def presses(rng: np.random.Generator, n: int, half: float = 15e-3) -> tuple[np.ndarray, np.ndarray]:
    return rng.uniform(-half, half, (n, 2)), rng.uniform(0, 4e-3, n)


def skin(rng: np.random.Generator):
    """A skin f(d) g(x): a function from presses to readings."""
    centre, size = rng.uniform(-20e-3, 20e-3, (40, 2)), rng.normal(size=(40, CHANNELS))

    def read(position: np.ndarray, travel: np.ndarray) -> np.ndarray:
        g = np.exp(-((position[:, None] - centre) ** 2).sum(-1) / 2 / 8e-3**2) @ size
        return 60 * g * (np.maximum(travel + 3e-3, 0) / 5e-3)[:, None] ** 1.75

    return read


def session(rng: np.random.Generator, n: int = 600) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    at = presses(rng, n)
    return *at, skin(rng)(*at) + rng.normal(size=(n, CHANNELS))


def wrong_in(*given, **more):
    """List the sentences of the findings that are wrong."""
    return [finding.sentence for finding in check_presses(*given, **more) if finding.wrong]


def test_sound_presses_raise_no_alarm():
    for seed in range(10):
        given = session(np.random.default_rng(100 + seed))
        assert wrong_in(*given) == []
        assert np.isfinite(check_presses(*given)[1].estimate)
    assert wrong_in(*session(np.random.default_rng(0), 20)) == []


def test_repeated_rows_and_a_changed_chip_are_found():
    position, load, readings = session(np.random.default_rng(14))
    repeated = readings.copy()
    repeated[[5, 6, 200]] = readings[4], readings[4], readings[199]
    np.testing.assert_array_equal(np.flatnonzero(repeated_rows(repeated)), [5, 6, 200])
    assert "3 rows repeat" in wrong_in(position, load, repeated)[0]

    changed = readings.copy()
    changed[300:, 6:9] += 35  # as much as one chip of a real board remembered of the press before
    finding = check_presses(position, load, changed)[1]
    assert finding.wrong
    assert finding.evidence["changed_chips"] == [2]
    assert "Chip 2" in finding.sentence

    moved = position + np.where(np.arange(600)[:, None] < 300, 0, 0.1)  # halves at different places tell nothing
    finding = check_presses(moved, load, readings)[1]
    assert not finding.wrong
    assert not finding.identifiable
    assert np.isnan(finding.estimate)


def test_a_skin_that_slips_is_found():
    rng = np.random.default_rng(12)
    position, travel = presses(rng, 600)
    slipped = position + np.where(np.arange(600)[:, None] < 300, 0.0, 4e-3)
    (sentence,) = wrong_in(position, travel, skin(rng)(slipped, travel) + rng.normal(size=(600, CHANNELS)))
    assert "the skin slipped or changed" in sentence


def test_a_steel_tip_is_found_by_its_sensitivity():
    position, travel, readings = session(np.random.default_rng(16), 50)
    force = 300 * travel  # up to 1.2 N
    readings *= 100 / np.median(np.linalg.norm(readings, axis=1) / force)  # uT/N, as real boards
    assert wrong_in(position, force, readings, by_force=True) == []
    (sentence,) = wrong_in(position, force, 7 * readings, by_force=True)
    assert "steel" in sentence
