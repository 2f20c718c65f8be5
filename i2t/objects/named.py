"""Objects as a command line names them: by their name in the catalogue, or by a mesh file and its unit.

What builds and reads meshes is imported where it is needed: a command's help need not wait for it.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from i2t.errors import did_you_mean

if TYPE_CHECKING:
    from i2t.objects.solids import Object

SHOWN_SHIFT_MM = 0.005  # smallest shift that two decimals of a millimetre show
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
    subject, path = f"{flag} {name}".strip(), Path(name)
    if not path.is_file():
        what = "is neither a mesh file nor an object of the catalogue" if catalogue else "is not a mesh file"
        if path.is_dir():
            raise ValueError(f"{subject}: {what} but a folder; name a file in it")
        if path.suffix or len(path.parts) > 1:
            raise ValueError(f"{subject}: {what}, as there is no such file; check the name{_folder_hint(path)}")
        raise ValueError(f"{subject}: {what}" + (f"; {did_you_mean(name, NAMES, CATALOGUE_HINT)}" if catalogue else ""))
    if unit is None:
        raise ValueError(f"{subject}: say in which unit the file is, for instance --unit mm")


def read_object(name: str, unit: str | None, *, largest_piece: bool = False) -> "Object":
    """An object by its name or file.

    Args:
        name: Of the catalogue, or a mesh file.
        unit: Of a mesh file: m, cm, mm or inch; it does not matter for an object of the catalogue.
        largest_piece: Whether only the largest connected piece of a mesh file is touched.

    Returns:
        The object.

    Raises:
        ValueError: There is no such name or file, its unit is missing, or it holds no usable mesh.
    """
    from i2t.objects.catalogue import NAMES, make_object
    from i2t.objects.mesh_files import load_object

    require_object(name, unit)
    return make_object(name) if name in NAMES else load_object(name, str(unit), largest_piece=largest_piece)


def describe_placement(thing: "Object") -> str:
    """Tell how an object's frame differs from its mesh file's, and what of the file is not touched.

    Args:
        thing: As `read_object` gives it.

    Returns:
        A sentence for people; empty where the frames are the same and nothing was left out.
    """
    x, y, z = (-1e3 * thing.T_file_object[:3, 3]).tolist()
    sentences = []
    if max(abs(x), abs(y), abs(z)) >= SHOWN_SHIFT_MM:
        sentences.append(
            f"the mesh was moved by {x:.2f}, {y:.2f}, {z:.2f} mm from its file's frame, to stand on z = 0 with its box "
            "centred in x and y"
        )
    if thing.left_out is not None:
        sentences.append(
            f"{len(thing.left_out.faces)} faces of other pieces are not touched, and the arm keeps clear of them"
        )
    return f"{thing.name}: {'; '.join(sentences)}" if sentences else ""


def _folder_hint(path: Path) -> str:
    """End of a sentence on a file that is not there: what is most like it in its folder, or that there is no folder."""
    if not path.parent.is_dir():
        return f", and there is no folder {path.parent}"
    hint = did_you_mean(path.name, (other.name for other in path.parent.iterdir()), "")
    return f"; {hint}" if hint else ""
