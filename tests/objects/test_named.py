"""Objects as a command line names them."""

import pytest

from i2t.objects.named import read_object, require_object

TETRAHEDRON = "v 0 0 0\nv 10 0 0\nv 0 10 0\nv 0 0 10\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture
def mesh(tmp_path):
    path = tmp_path / "mug.obj"
    path.write_text(TETRAHEDRON)
    return str(path)


def test_names_of_the_catalogue_and_files_with_a_unit_are_objects(mesh):
    assert read_object("star", None).name == read_object("star", "mm").name == "star"
    found = read_object(mesh, "mm")
    assert found.name == "mug"
    assert abs(found.mesh.vertices[:, 2].max() - 10e-3) < 1e-6


@pytest.mark.parametrize("flag", ["--object", ""])
def test_what_is_neither_is_refused_with_its_flag(mesh, flag):
    lead = f"^{flag} " if flag else "^"
    with pytest.raises(ValueError, match=f"{lead}cup.stl: is neither a mesh file nor an object of the catalogue"):
        require_object("cup.stl", "mm", flag=flag)
    with pytest.raises(ValueError, match=f"{lead}{mesh}: say in which unit the file is"):
        require_object(mesh, None, flag=flag)
    with pytest.raises(ValueError, match=f"{lead}star: is not a mesh file$"):
        require_object("star", "mm", flag=flag, catalogue=False)
    with pytest.raises(ValueError, match=r"^cup\.stl: is neither"):
        read_object("cup.stl", None)
