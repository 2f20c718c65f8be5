"""Objects as a command line names them."""

import pytest

from i2t.errors import DataError
from i2t.objects.catalogue import NAMES, make_object
from i2t.objects.named import meshes_of_dataset, read_object, require_object

TETRAHEDRON = "v 0 0 0\nv 10 0 0\nv 0 10 0\nv 0 0 10\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_only_catalogue_names_and_files_with_a_unit_are_objects(tmp_path):
    mesh = tmp_path / "mug.obj"
    mesh.write_text(TETRAHEDRON)
    assert read_object("star", None).name == read_object("star", "mm").name == "star"
    thing = read_object(str(mesh), "mm")
    assert thing.name == "mug"
    assert abs(thing.mesh.vertices[:, 2].max() - 10e-3) < 1e-6
    for name, unit, catalogue, problem in (
        ("cup.stl", "mm", True, "^--object cup.stl: is neither a mesh file nor an object of the catalogue"),
        (str(mesh), None, True, "its unit is missing"),
        ("star", "mm", False, "star: is not a mesh file$"),
        ("hamer", None, True, r"^--object hamer: is neither a mesh file nor .* catalogue; did you mean hammer\?$"),
        ("Hammer", None, True, r"did you mean hammer\?$"),
        ("teapot", None, True, r"catalogue; see its names with: python -c"),
        ("cup.stl", "mm", True, r"as there is no such file; check the name"),
        ("models/cup", "mm", True, r"as there is no such file; check the name, and there is no folder models$"),
        (str(tmp_path / "mugg.obj"), "mm", True, r"as there is no such file; check the name; did you mean mug.obj\?$"),
        (str(tmp_path), "mm", True, "but a folder; name a file in it"),
    ):
        with pytest.raises(ValueError, match=problem):
            require_object(name, unit, flag="--object", catalogue=catalogue)


def test_messages_about_a_wrong_name_do_not_list_the_catalogue():
    for name in ("hamer", "teapot", "cup.stl", "models/cup"):
        for ask in (lambda name: require_object(name, None), make_object):
            with pytest.raises(ValueError, match=name) as caught:
                ask(name)
            assert sum(f" {listed}" in str(caught.value) for listed in NAMES) <= 2
    with pytest.raises(ValueError, match=r"no object is called 'hamer'; did you mean hammer\?"):
        make_object("hamer")


def test_candidates_are_those_of_the_data_set_where_the_catalogue_has_them():
    names, path = ("star", "square", "hammer"), "DATA"
    assert tuple(meshes_of_dataset(names, path)) == names
    with pytest.raises(DataError, match=r"touches of mug, of which there is no mesh.*--objects star mug.stl"):
        meshes_of_dataset(("star", "mug"), path)
    with pytest.raises(DataError, match="touches of star only; name the objects to distinguish"):
        meshes_of_dataset(("star",), path)
