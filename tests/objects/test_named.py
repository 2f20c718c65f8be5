"""Objects as a command line names them."""

import pytest

from i2t.objects.named import read_object, require_object

TETRAHEDRON = "v 0 0 0\nv 10 0 0\nv 0 10 0\nv 0 0 10\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_names_of_the_catalogue_and_files_with_a_unit_are_objects_and_nothing_else_is(tmp_path):
    mesh = tmp_path / "mug.obj"
    mesh.write_text(TETRAHEDRON)
    assert read_object("star", None).name == read_object("star", "mm").name == "star"
    found = read_object(str(mesh), "mm")
    assert found.name == "mug"
    assert abs(found.mesh.vertices[:, 2].max() - 10e-3) < 1e-6
    for name, unit, catalogue, problem in (
        ("cup.stl", "mm", True, "^--object cup.stl: is neither a mesh file nor an object of the catalogue"),
        (str(mesh), None, True, "say in which unit the file is"),
        ("star", "mm", False, "star: is not a mesh file$"),
    ):
        with pytest.raises(ValueError, match=problem):
            require_object(name, unit, flag="--object", catalogue=catalogue)
