"""Kinds of file that are no mesh, or none of the formats that are read."""

import codecs
import re
from pathlib import Path

from i2t.errors import DataError
from i2t.objects.formats.stl import FACET_BYTES, STL_HEADER

CONVERT = "convert it to STL, for instance with Blender"
FROM_CAD = "export it as STL from a CAD program"
FOREIGN_SUFFIXES = {
    **dict.fromkeys((".step", ".stp", ".iges", ".igs", ".brep", ".3dm", ".sldprt", ".sldasm", ".ipt", ".x_t", ".x_b",
                     ".f3d", ".fcstd", ".catpart", ".prt", ".sat", ".scad", ".dxf", ".dwg"), ("a CAD model", FROM_CAD)),
    **dict.fromkeys((".3mf", ".amf", ".dae", ".fbx", ".usd", ".usda", ".usdc", ".usdz", ".blend", ".3ds", ".max",
                     ".ma", ".mb", ".c4d", ".wrl", ".x3d", ".vtk", ".vtp", ".vtu", ".msh", ".abc"),
                    ("a mesh or scene of another format", CONVERT)),
    **dict.fromkeys((".pcd", ".xyz", ".las", ".laz", ".e57", ".pts"),
                    ("a point cloud", "make it a mesh first, for instance with Open3D")),
    **dict.fromkeys((".zip", ".gz", ".7z", ".rar", ".tar"), ("an archive", "unpack it, and name the mesh in it")),
}  # fmt: skip
FOREIGN_MARKS = (  # how files begin that are no mesh of ours, whatever their ending says
    (rb"version https://git-lfs", "a Git LFS pointer, not the mesh itself", "run git lfs pull"),
    (rb"(?:\.\./)*\.git/annex|/annex/objects", "a git-annex pointer, not the mesh itself", "run git annex get"),
    (rb"<!doctype html|<html", "a web page, not the mesh itself", "download the file behind it"),
    (rb"iso-10303-21", "a STEP file", FROM_CAD),
    (rb"[^\r\n]{72}s[ 0]{6}1\b", "an IGES file", FROM_CAD),
    (rb"dbrep_drawableshape|cascade topology", "a BREP file", FROM_CAD),
    (rb"3d geometry file format", "a Rhino file (3DM)", FROM_CAD),
    (rb"kaydara fbx|; fbx", "an FBX file", CONVERT),
    (rb"blender|\x28\xb5\x2f\xfd", "a Blender file", "export it as STL from Blender"),
    (rb"pxr-usd|#usda", "a USD file", CONVERT),
    (rb"#vrml|# vtk", "a VRML or VTK file", CONVERT),
    (rb"# \.pcd", "a point cloud (PCD)", "make it a mesh first, for instance with Open3D"),
    (rb"(?:<\?xml[^>]*>\s*)?(?:<!--.*?-->\s*)*<(?:\w+:)?collada", "a Collada file (DAE)", CONVERT),
    (rb"<\?xml|<x3d|<amf|<vtkfile", "a file in XML", CONVERT),
    (rb"pk\x03\x04.{,4096}3d/", "a 3MF file", CONVERT),
    (rb"pk\x03\x04|\x1f\x8b|7z\xbc\xaf|rar!", "an archive", "unpack it, and name the mesh in it"),
    (rb"\x89png|\xff\xd8\xff|%pdf|gif8", "an image or a document, not a mesh", "name the mesh"),
)  # fmt: skip
OWN_MARKS = (  # how files of the formats begin that are read
    (".ply", rb"ply\s"),
    (".glb", rb"gltf"),
    (".off", rb"(?:st)?c?n?4?n?off\b"),
    (".gltf", rb"\{.*\"asset\""),
    (".stl", rb"solid\b.*?facet\s+normal"),
    (".obj", rb"(?:.*\n)?[ \t]*v(?:[ \t]+[-+.,\de]+){3}"),
)


def foreign_kind(suffix: str) -> tuple[str, str]:
    """Say what a file is that has an ending which is not read.

    Args:
        suffix: The ending, with its point.

    Returns:
        What it is ("" where that is unknown), and what to do.
    """
    return FOREIGN_SUFFIXES.get(suffix.lower(), ("", "convert it to one of them"))


def check_kind(path: Path, suffix: str, data: bytes) -> None:
    """Refuse contents of another kind than the suffix says.

    Args:
        path: The file, named in the error.
        suffix: Its suffix in small letters, with the point.
        data: Its bytes.

    Raises:
        DataError: The file is no mesh, or a mesh of another format.
    """
    if suffix == ".stl" and len(data) == STL_HEADER + FACET_BYTES * int.from_bytes(data[80:84], "little"):
        return  # a header may begin with any words
    head = data[:8192].removeprefix(codecs.BOM_UTF8).lstrip().lower()
    for mark, kind, remedy in FOREIGN_MARKS:
        if re.match(mark, head, re.DOTALL):
            raise DataError(f"{path}: is {kind}; {remedy}")
    kinds = [own for own, mark in OWN_MARKS if re.search(rb"\A" + mark, head, re.DOTALL)]
    welcome = (".glb", ".gltf") if suffix in (".glb", ".gltf") else (suffix,)
    if kinds and not set(kinds) & set(welcome):
        raise DataError(
            f"{path}: is {kinds[0][1:].upper()} by its contents and {suffix[1:].upper()} by its ending; rename it to "
            f"{path.stem}{kinds[0]}"
        )
