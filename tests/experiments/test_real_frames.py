"""The experiment on real frames: its numbers where the difference is known, its refusals, and a small real run."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.registration.arguments import FramesArgs
from experiments.registration.frames import Compared, run, summary
from i2t.depth.patches import DepthPatch
from i2t.types import Patch


def test_summary_of_known_differences():
    """Noise of 1 mm: its absolute values have the median 0.674 mm, and its quartiles are twice that apart."""
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 1e-3, (5, 20, 48, 48))
    noise[0, 0] = np.nan  # a patch of which nothing could be compared
    bias = np.where(np.isfinite(noise[..., 0, 0]), 2e-3, np.nan)
    seen = np.ones(noise.shape, bool)
    patch = Patch(np.zeros(noise.shape), np.zeros((5, 20)))
    values = summary(Compared(DepthPatch(patch, seen, ~seen), patch, noise + 2e-3, bias))
    # A median of 2304 values is known to 1.25 sigma' / 48, which is 0.02 mm here; of 99 such medians to a tenth of it.
    assert values["median_absolute_mm"] == pytest.approx(0.6745, abs=0.01)
    low, high = values["interval_95_mm"]
    assert low <= values["median_absolute_mm"] <= high
    assert high - low < 0.02
    assert values["interquartile_range_mm"] == pytest.approx(2 * 0.6745, abs=0.01)
    assert values["bias_median_mm"] == pytest.approx(2)
    assert values["patches"] == 99
    assert values["too_few_pixels"] == 1
    assert values["sites"] == 20


def test_missing_data_sets_are_refused(tmp_path):
    with pytest.raises(ValueError, match="ycbvideo is missing"):
        run(FramesArgs(tmp_path, tmp_path / "out"))
    for folder in ("ycbvideo", "ycb_meshes", "apc_depth"):
        (tmp_path / folder).mkdir()
    (tmp_path / "metrics.json").write_text("{}")
    with pytest.raises(ValueError, match="holds no run of this experiment"):
        run(FramesArgs(tmp_path, tmp_path))


@pytest.mark.full
def test_real_run(shared_data: Path, tmp_path):
    """The camera's own step is 1 mm and its noise as much: a median difference beyond 1 mm means a wrong frame."""
    run(FramesArgs(shared_data, tmp_path, sites=4, windows=(17e-3,)))
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert set(metrics["objects"]) == {"009_gelatin_box", "025_mug", "061_foam_brick"}
    for windows in metrics["objects"].values():
        assert windows["17 mm"]["median_absolute_mm"] < 1
        assert abs(windows["17 mm"]["bias_median_mm"]) < 1
    assert all(0.1 < share < 1 for share in metrics["f200_measured"].values())
