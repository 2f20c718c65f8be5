"""Objects as a command line names them: by their name in the catalogue, or by a mesh file and its unit.

What builds and reads meshes is imported where it is needed: a command's help need not wait for it.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from i2t.errors import did_you_mean

if TYPE_CHECKING:
    from i2t.objects.solids import Object


CATALOGUE_HINT = 'see its names with: python -c "import i2t.objects; print(i2t.objects.NAMES)"'


def require_object(name: str, unit: str | None, *, flag: str = "", catalogue: bool = True) -> None:
    """Refuse what is neither an object of the catalogue nor a mesh file with its unit.

    Args:
        name: Of the catalogue, or a mesh file.
        unit: Of the file; None where none was given.
        flag: The option that names it, for messages; "" where it needs none.
        catalogue: Whether names of the catalogue are welcome.

    Raises:
        ValueError: It is neither.
    """
    from i2t.objects.catalogue import NAMES

    if catalogue and name in NAMES:
        return
    said, path = f"{flag} {name}".strip(), Path(name)
    if not path.is_file():
        what = "is neither a mesh file nor an object of the catalogue" if catalogue else "is not a mesh file"
        if path.is_dir():
            raise ValueError(f"{said}: {what} but a folder; name a file in it")
        if path.suffix or len(path.parts) > 1:
            raise ValueError(f"{said}: {what}, as there is no such file; check the name{_folder_hint(path)}")
        raise ValueError(f"{said}: {what}" + (f"; {did_you_mean(name, NAMES, CATALOGUE_HINT)}" if catalogue else ""))
    if unit is None:
        raise ValueError(f"{said}: say in which unit the file is, for instance --unit mm")


def read_object(name: str, unit: str | None) -> "Object":
    """An object by its name or file.

    Args:
        name: Of the catalogue, or a mesh file.
        unit: Of a mesh file: m, cm, mm or inch; it does not matter for an object of the catalogue.

    Returns:
        The object.

    Raises:
        ValueError: There is no such name or file, its unit is missing, or it holds no usable mesh.
    """
    from i2t.objects.catalogue import NAMES, make_object
    from i2t.objects.mesh_files import load_object

    require_object(name, unit)
    return make_object(name) if name in NAMES else load_object(name, str(unit))


def _folder_hint(path: Path) -> str:
    """End of a sentence on a file that is not there: what is most like it in its folder, or that there is no folder."""
    if not path.parent.is_dir():
        return f", and there is no folder {path.parent}"
    hint = did_you_mean(path.name, (other.name for other in path.parent.iterdir()), "")
    return f"; {hint}" if hint else ""
