"""Recognition of files that are not meshes, or are meshes of another format than their suffix indicates."""

import codecs
import re
from enum import StrEnum
from pathlib import Path

from i2t.errors import DataError
from i2t.objects.formats.stl import is_binary_stl


class _Remedy(StrEnum):
    """What a user can do to get a mesh out of a file of another kind."""

    CONVERT = "convert it to STL, for instance with Blender"
    EXPORT = "export it as STL from a CAD program"
    MAKE_MESH = "make it a mesh first, for instance with Open3D"
    UNPACK = "unpack it, and name the mesh in it"


# File name endings of formats that are not read, with their kind and remedy.
FOREIGN_SUFFIXES = {
    **dict.fromkeys((".step", ".stp", ".iges", ".igs", ".brep", ".3dm", ".sldprt", ".sldasm", ".ipt", ".x_t", ".x_b",
                     ".f3d", ".fcstd", ".catpart", ".prt", ".sat", ".scad", ".dxf", ".dwg"),
                    ("a CAD model", _Remedy.EXPORT)),
    **dict.fromkeys((".3mf", ".amf", ".dae", ".fbx", ".usd", ".usda", ".usdc", ".usdz", ".blend", ".3ds", ".max",
                     ".ma", ".mb", ".c4d", ".wrl", ".x3d", ".vtk", ".vtp", ".vtu", ".msh", ".abc"),
                    ("a mesh or scene of another format", _Remedy.CONVERT)),
    **dict.fromkeys((".pcd", ".xyz", ".las", ".laz", ".e57", ".pts"), ("a point cloud", _Remedy.MAKE_MESH)),
    **dict.fromkeys((".zip", ".gz", ".7z", ".rar", ".tar"), ("an archive", _Remedy.UNPACK)),
}  # fmt: skip
# Patterns of the beginnings of files that are not read, whatever their suffix, with their kind and remedy.
FOREIGN_MARKS = (
    (rb"version https://git-lfs", "a Git LFS pointer, not the mesh itself", "run git lfs pull"),
    (rb"(?:\.\./)*\.git/annex|/annex/objects", "a git-annex pointer, not the mesh itself", "run git annex get"),
    (rb"<!doctype html|<html", "a web page, not the mesh itself", "download the file behind it"),
    (rb"iso-10303-21", "a STEP file", _Remedy.EXPORT),
    (rb"[^\r\n]{72}s[ 0]{6}1\b", "an IGES file", _Remedy.EXPORT),
    (rb"dbrep_drawableshape|cascade topology", "a BREP file", _Remedy.EXPORT),
    (rb"3d geometry file format", "a Rhino file (3DM)", _Remedy.EXPORT),
    (rb"kaydara fbx|; fbx", "an FBX file", _Remedy.CONVERT),
    (rb"blender|\x28\xb5\x2f\xfd", "a Blender file", "export it as STL from Blender"),
    (rb"pxr-usd|#usda", "a USD file", _Remedy.CONVERT),
    (rb"#vrml|# vtk", "a VRML or VTK file", _Remedy.CONVERT),
    (rb"# \.pcd", "a point cloud (PCD)", _Remedy.MAKE_MESH),
    (rb"(?:<\?xml[^>]*>\s*)?(?:<!--.*?-->\s*)*<(?:\w+:)?collada", "a Collada file (DAE)", _Remedy.CONVERT),
    (rb"<\?xml|<x3d|<amf|<vtkfile", "a file in XML", _Remedy.CONVERT),
    (rb"pk\x03\x04.{,4096}3d/", "a 3MF file", _Remedy.CONVERT),
    (rb"pk\x03\x04|\x1f\x8b|7z\xbc\xaf|rar!", "an archive", _Remedy.UNPACK),
    (rb"\x89png|\xff\xd8\xff|%pdf|gif8", "an image or a document, not a mesh", "name the mesh"),
)  # fmt: skip
# Patterns of the beginnings of mesh files that are read, by file name ending.
MESH_MARKS = (
    (".ply", rb"ply\s"),
    (".glb", rb"gltf"),
    (".off", rb"(?:st)?c?n?4?n?off\b"),
    (".gltf", rb"\{.*\"asset\""),
    (".stl", rb"solid\b.*?facet\s+normal"),
    (".obj", rb"(?:.*\n)?[ \t]*v(?:[ \t]+[-+.,\de]+){3}"),
)


def foreign_kind(suffix: str) -> tuple[str, str]:
    """Recognise the kind of a file from a suffix that no reader accepts.

    Args:
        suffix: The suffix, with its dot.

    Returns:
        The kind of file, empty if it is unknown, and what to do.
    """
    return FOREIGN_SUFFIXES.get(suffix.lower(), ("", "convert it to one of them"))


def check_kind(path: Path, suffix: str, data: bytes) -> None:
    """Refuse a file whose contents are of another kind than its suffix indicates.

    Args:
        path: The file's path, for messages.
        suffix: The suffix in lower case, with its dot.
        data: The file's bytes.

    Raises:
        DataError: The file is not a mesh, or is a mesh of another format.
    """
    if suffix == ".stl" and is_binary_stl(data):
        return  # its header may begin with any words
    head = data[:8192].removeprefix(codecs.BOM_UTF8).lstrip().lower()
    for mark, kind, remedy in FOREIGN_MARKS:
        if re.match(mark, head, re.DOTALL):
            raise DataError(f"{path}: is {kind}; {remedy}")
    kinds = [own for own, mark in MESH_MARKS if re.search(rb"\A" + mark, head, re.DOTALL)]
    accepted = (".glb", ".gltf") if suffix in (".glb", ".gltf") else (suffix,)
    if kinds and not set(kinds) & set(accepted):
        raise DataError(
            f"{path}: is {kinds[0][1:].upper()} by its contents and {suffix[1:].upper()} by its ending; rename it to "
            f"{path.stem}{kinds[0]}"
        )
