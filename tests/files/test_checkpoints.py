"""The file of a checkpoint that is read without orbax holds what orbax returns."""

import numpy as np
from orbax.checkpoint import v1 as ocp

from i2t.files.checkpoints import custom_metadata, is_checkpoint

CHANGED = "orbax changed the file that i2t/files/checkpoints.py reads: adapt it, and the bound in pyproject.toml"


def test_metadata_is_what_orbax_returns(tmp_path):
    about = {"format": "mine", "values": [1, 2.5, None, {"a": "b"}]}
    ocp.save_checkpointables(tmp_path / "one", {"arrays": {"x": np.ones(3)}}, custom_metadata=about)
    assert is_checkpoint(tmp_path / "one"), CHANGED
    assert not is_checkpoint(tmp_path)
    stored = ocp.checkpointables_metadata(tmp_path / "one").custom_metadata
    assert custom_metadata(tmp_path / "one") == stored == about, CHANGED
