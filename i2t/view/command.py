"""The command line of `python -m i2t.view`."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from i2t.cli.exit_codes import command
from i2t.cli.options import Count, require_with, require_writable
from i2t.files.reading import why_no_touches
from i2t.objects.named import require_object


@dataclass(frozen=True)
class ViewArgs:
    """Write a session or data set as a Rerun recording (.rrd) and as a page (.html) to look at."""

    path: tyro.conf.Positional[Path]
    """Folder of recorded touches, or a data set."""
    out: Path = Path("runs/view")
    """Folder for the files, which are named as what they show."""
    mesh: str | None = None
    """The object: a name of the catalogue, or a mesh file; by default by its name in the touches."""
    unit: Literal["m", "cm", "mm", "inch"] | None = None
    """Of a mesh file, which does not say it itself."""
    touches: Count | None = None
    """Look at so many at most, the first ones."""
    skin_name: str | None = None
    """Of several skins that were read in each touch, the one to look at."""
    html: bool = False
    """Write the page alone."""
    overwrite: bool = False
    """Replace files that are there."""


def _write(asked: ViewArgs) -> None:
    require_with("--unit", asked.unit is not None, "--mesh", asked.mesh is not None)
    if asked.mesh is not None:
        require_object(asked.mesh, asked.unit, flag="--mesh")
    if asked.path.is_file() and (why := why_no_touches(asked.path)):
        raise ValueError(why)
    name = (asked.path.resolve().stem or "view") + (f"-{asked.skin_name}" if asked.skin_name else "")
    page, recording = (asked.out / f"{name}{ending}" for ending in (".html", ".rrd"))
    for path in (page, recording):
        if path.exists() and not asked.overwrite:
            raise FileExistsError(f"{path}: exists already; pass --overwrite to replace it, or another --out")
        require_writable("--out", path)
    # Not above: NumPy and HDF5, which --help and a refusal need not wait for.
    from i2t.view.contents import read_contents
    from i2t.view.page import write_page
    from i2t.view.rerun_file import why_no_recording, write_recording

    contents = read_contents(asked.path, mesh=asked.mesh, unit=asked.unit, most=asked.touches, skin=asked.skin_name)
    asked.out.mkdir(parents=True, exist_ok=True)
    print(f"wrote {write_page(contents, page)}")
    if asked.html:
        return
    missing = why_no_recording()
    if missing:
        print(missing, file=sys.stderr)
        return
    print(f"wrote {write_recording(contents, recording)}; look at it with: rerun {recording}")


main = command(ViewArgs, _write, program="python -m i2t.view")
