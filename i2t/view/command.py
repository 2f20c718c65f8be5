"""Command line of `i2t view`."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from i2t.cli.exit_codes import command
from i2t.cli.options import Count, require_with, require_writable
from i2t.files.reading import explain_no_dataset
from i2t.objects.named import require_object


@dataclass(frozen=True)
class ViewArgs:
    """Write a session or data set as a Rerun recording (.rrd) and an HTML page for viewing."""

    path: tyro.conf.Positional[Path]
    """Folder of recorded touches, or a data set to show."""
    out: Path = Path("runs/view")
    """Folder in which the files are written; the files are named after PATH."""
    mesh: str | None = None
    """Object: its name in the catalogue, or a mesh file. By default, the object that the touches name."""
    unit: Literal["m", "cm", "mm", "inch"] | None = None
    """Unit of the mesh file, if its name has none (mug.stl:mm); glTF is in metres."""
    touches: Count | None = None
    """Maximum number of touches to show; the first ones are shown. By default, all."""
    skin_name: str | None = None
    """Name of the skin to show; required if each touch has readings of several skins."""
    html: bool = False
    """Write only the HTML page, no Rerun recording."""
    overwrite: bool = False
    """Replace existing files."""


def _write(args: ViewArgs) -> None:
    require_with("--unit", args.unit is not None, "--mesh", args.mesh is not None)
    if args.mesh is not None:
        require_object(args.mesh, args.unit, flag="--mesh")
    if args.path.is_file() and (why := explain_no_dataset(args.path)):
        raise ValueError(why)
    name = (args.path.resolve().stem or "view") + (f"-{args.skin_name}" if args.skin_name else "")
    page, recording = (args.out / f"{name}{ending}" for ending in (".html", ".rrd"))
    for path in (page, recording):
        if path.exists() and not args.overwrite:
            raise FileExistsError(f"{path}: exists already; pass --overwrite to replace it, or another --out")
        require_writable("--out", path)
    # Imported late, because --help and refusals do not need NumPy and HDF5.
    from i2t.view.contents import read_contents
    from i2t.view.page import write_page
    from i2t.view.rerun_file import explain_no_recording, write_recording

    contents = read_contents(args.path, mesh=args.mesh, unit=args.unit, max_touches=args.touches, skin=args.skin_name)
    args.out.mkdir(parents=True, exist_ok=True)
    print(f"wrote {write_page(contents, page)}")
    if args.html:
        return
    missing = explain_no_recording()
    if missing:
        print(missing, file=sys.stderr)
        return
    print(f"wrote {write_recording(contents, recording)}; look at it with: rerun {recording}")


main = command(ViewArgs, _write, program="python -m i2t.view")
