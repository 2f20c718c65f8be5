"""Check of the folder of a collection, without NumPy, so that a folder that cannot be used is refused at once."""

import shutil
from pathlib import Path

from i2t.cli.options import require_writable
from i2t.errors import DataError, FullDiskError

# file, in a collection's folder, with the settings that a resumed collection must share
NOTES_FILE = ".collection.json"
TOUCH_FILES = "touch-*.h5"  # pattern of the names of touches in a collection's folder
MIN_FREE_BYTES = 50 * 2**20  # required space on its disk, enough for a hundred touches
# Visible files of a data set that are not touches.


def check_out(out: Path) -> None:
    """Refuse a folder in which no touches can be collected. Nothing is created.

    Args:
        out: The folder, which need not exist. A collection that was begun in it can be resumed.

    Raises:
        ValueError: A file is at the path or above it, or writing there is not permitted.
        DataError: The folder holds files that no collection wrote, or touches of another origin.
        FullDiskError: Less than `MIN_FREE_BYTES` are free on the disk.
    """
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out {out}: is a file; name a folder")
    require_writable("--out", out)
    existing = next((folder for folder in (out, *out.parents) if folder.exists()), Path())
    free = shutil.disk_usage(existing).free
    if free < MIN_FREE_BYTES:
        raise FullDiskError(
            f"--out {out}: only {free / 2**20:.0f} MiB are free, but {MIN_FREE_BYTES / 2**20:.0f} are required; free "
            "some space, or choose another --out"
        )
    names = [file.name for file in out.iterdir() if file.is_file()] if out.is_dir() else []
    visible = sorted(name for name in names if not name.startswith(".") and name not in ("README.md", "index.json"))
    foreign = [name for name in visible if not Path(name).match(TOUCH_FILES)]
    if foreign:
        raise DataError(f"--out {out}: holds {foreign[0]}, which no collection wrote; move it, or choose another --out")
    if visible and NOTES_FILE not in names:
        raise DataError(f"--out {out}: holds touches that this command did not collect; choose another --out")
