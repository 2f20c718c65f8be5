"""Objects as a command line names them."""

import numpy as np
import pytest
import trimesh

from i2t.errors import DataError
from i2t.objects.catalogue import NAMES, make_object
from i2t.objects.named import (
    meshes_of_dataset,
    object_name,
    read_meshes,
    read_object,
    require_object,
    split_unit,
    units_of,
)

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


def test_a_unit_after_a_colon_is_that_of_the_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("mug.obj", "mug.obj:mm", "a:b.obj"):
        (tmp_path / name).write_text(TETRAHEDRON)
    for name, parts in (
        ("star", ("star", None)),
        ("cup.stl:mm", ("cup.stl", "mm")),
        ("parts/cup.v2.STL:inch", ("parts/cup.v2.STL", "inch")),
        (r"C:\parts\cup.stl", (r"C:\parts\cup.stl", None)),
        (r"C:\parts\cup.stl:cm", (r"C:\parts\cup.stl", "cm")),
        ("a:b.obj", ("a:b.obj", None)),
        ("a:b.obj:mm", ("a:b.obj", "mm")),
        ("mug.obj:mm", ("mug.obj:mm", None)),  # a file of that name exists
        ("mug.obj:m", ("mug.obj", "m")),
    ):
        assert split_unit(name) == parts
    for word, remedy in (("MM", "did you mean mm"), ("inches", "did you mean inch"), ("parsec", "choose one of m, cm")):
        with pytest.raises(ValueError, match=f"^mug.obj:{word}: {word} is not a unit of length; {remedy}"):
            split_unit(f"mug.obj:{word}")
    assert object_name("a:b.obj:mm") == "a:b"
    for unit in (None, "m"):  # the suffix takes precedence
        assert abs(read_object("a:b.obj:mm", unit).mesh.vertices[:, 2].max() - 10e-3) < 1e-6


def test_the_unit_option_is_for_the_files_that_have_none():
    assert units_of(["a.stl:mm", "b.stl", "mug.glb", "star"], "cm") == ["cm", "cm", None, "cm"]
    assert units_of(["mug.glb", "cup.gltf", "star"], "cm") == ["cm", "cm", "cm"]  # overrides metres
    assert units_of(["mug.glb", "cup.stl"], None) == [None, None]


def test_several_objects_are_read_in_their_own_units(tmp_path):
    sides = {"a.stl:mm": 30.0, "b.stl": 3.0, "c.glb": 0.03, "d.glb:inch": 0.03 / 0.0254}
    for name, side in sides.items():
        trimesh.creation.box((side, side, side)).export(tmp_path / name.split(":")[0])
    with pytest.warns(UserWarning, match="d.glb: is read in inch, as given, although glTF is in metres") as caught:
        meshes = read_meshes([tmp_path / name for name in sides], "cm")
    assert len(caught) == 1
    assert list(meshes) == ["a", "b", "c", "d"]
    for mesh in meshes.values():
        np.testing.assert_allclose(mesh.vertices.max(0), [0.015, 0.015, 0.03], rtol=1e-6)


def test_candidates_are_those_of_the_data_set_where_the_catalogue_has_them():
    names, path = ("star", "square", "hammer"), "DATA"
    assert tuple(meshes_of_dataset(names, path)) == names
    with pytest.raises(DataError, match=r"touches of mug, of which there is no mesh.*--objects star mug.stl"):
        meshes_of_dataset(("star", "mug"), path)
    with pytest.raises(DataError, match="touches of star only; name the objects to distinguish"):
        meshes_of_dataset(("star",), path)
