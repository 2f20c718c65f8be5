"""Files of orbax's checkpoints that are read without orbax, which imports JAX and reads files of any size.

Orbax documents the content (`orbax.checkpoint.v1.checkpointables_metadata(folder).custom_metadata`) but not the file,
so pyproject.toml bounds its version, and `tests/files/test_checkpoints.py` fails where the file changed.
"""

from pathlib import Path
from typing import Any

from i2t.files.reading import read_json

_METADATA_FILE = "_CHECKPOINT_METADATA"  # file in which Orbax keeps a checkpoint's metadata


def is_checkpoint(folder: Path) -> bool:
    """Test whether a folder holds a checkpoint of orbax.

    Args:
        folder: The folder, which may be missing.

    Returns:
        True if the folder holds the file of a checkpoint's metadata.
    """
    return (folder / _METADATA_FILE).is_file()


def custom_metadata(folder: Path) -> dict[str, Any]:
    """Read the metadata that a program saved in an orbax checkpoint along with its arrays.

    Args:
        folder: The checkpoint.

    Returns:
        The metadata, as the program passed them to orbax.

    Raises:
        OSError: The file is missing or is not a regular file.
        ValueError: The file is too large, or is not JSON.
        KeyError: The checkpoint holds no metadata of a program.
        TypeError: The file holds something else than a checkpoint's metadata.
    """
    metadata: dict[str, Any] = read_json(folder / _METADATA_FILE, 2**26)["custom_metadata"]
    return metadata
