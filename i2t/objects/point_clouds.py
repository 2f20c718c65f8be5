"""Point clouds as surfaces: PLY and PCD files, and small disks that stand in for the surface between the points.

Both formats are a text header and a table of points, in ASCII or binary; only positions and normals are read. A cloud
has no surface, so `surface_from_points` puts a hexagonal disk of a stated radius on it, facing the normal of the
plane fitted to the neighbours (principal components: Hoppe et al., "Surface reconstruction from unorganized points",
1992): a layer of splats (Pfister et al., "Surfels", 2000), not a reconstruction. Metres.
"""

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from i2t.objects.mesh_files import check_size, read_bytes, to_metres
from i2t.objects.solids import Mesh

PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float32": "f4", "float64": "f8"},
}
MAX_FIT_NEIGHBOURS = 32  # at most, in a plane fit; disks lie half a radius apart, so some 28 lie within 1.5 radii
SPACING_NEIGHBOUR = 8  # neighbours whose distance tells how dense a cloud is
RADIUS_IN_SPACINGS = 2.0  # radius of a disk in spacings
MIN_FIT_POINTS = 5  # points of a plane fit; a point with fewer around it is an outlier


def load_point_cloud(path: str | Path, unit: str) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Read a point cloud. Points that are not finite mark missing measurements and are left out.

    Args:
        path: A PLY or PCD file; compressed PCD files are refused.
        unit: Of its coordinates: m, cm, mm or inch.

    Returns:
        Points (n, 3) in metres, and unit normals (n, 3), zero where one is missing, or None where the file has none.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read; one sentence that names the file and a remedy.
    """
    path = Path(path)
    data = read_bytes(path, (".ply", ".pcd"))
    scale = to_metres(path, unit)
    parse = _ply if path.suffix.lower() == ".ply" else _pcd
    try:
        table = parse(data)
    except (ValueError, LookupError, StopIteration, TypeError, ArithmeticError, MemoryError) as error:
        reason = f"misses {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise ValueError(f"{path}: cannot be read as {path.suffix[1:].upper()} ({reason}); export it again") from error
    if not {"x", "y", "z"} <= set(table):
        raise ValueError(f"{path}: has no fields x, y, z; export it with positions")
    points = np.stack([table[k] for k in "xyz"], -1) * scale
    whole = np.isfinite(points).all(1)
    if not whole.any():
        raise ValueError(f"{path}: holds no finite point; export it again")
    points = points[whole]
    check_size(path, points, unit)
    for names in (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z")):
        if set(names) <= set(table):
            normals = np.stack([table[k] for k in names], -1)[whole]
            length = np.linalg.norm(normals, axis=1, keepdims=True)
            # A normal that is missing or zero stays zero: `surface_from_points` then keeps its own.
            return points, np.where(np.isfinite(length) & (length > 0), normals / np.where(length > 0, length, 1), 0.0)
    return points, None


def suggest_radius(points: NDArray) -> float:
    """A radius of disks that covers a cloud: twice its typical spacing s, where a point has s^2 to itself.

    On a surface k neighbours lie within d_k, pi d_k^2 = k s^2; the median over points of the eighth's distance gives s.
    Of points strewn at random a disk of 2 s misses a place with probability exp(-4 pi) = 3e-6; averaging them in cubes
    of edge s leaves at least 63 % of their number, so 4e-4 of the surface at most is left bare. Noise makes the cloud
    look wider and the radius larger, as it should.

    Args:
        points: The cloud (n, 3) in metres.

    Returns:
        The radius (m).

    Raises:
        ValueError: There are fewer than nine points, or most lie in the same place.
    """
    points = np.asarray(points, np.float64)
    if len(points) <= SPACING_NEIGHBOUR:
        raise ValueError(f"points: {len(points)} are too few to tell a spacing; give at least {SPACING_NEIGHBOUR + 1}")
    distance, _ = cKDTree(points).query(points, k=[SPACING_NEIGHBOUR + 1])  # the first neighbour is the point itself
    radius = RADIUS_IN_SPACINGS * float(np.median(distance)) * np.sqrt(np.pi / SPACING_NEIGHBOUR)
    if not radius > 0:
        raise ValueError("points: most of them lie in the same place; remove the repeated ones")
    return float(radius)


def surface_from_points(
    points: NDArray,
    radius: float,
    normals: NDArray | None = None,
    up: NDArray | tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Mesh:
    """Cover points with disks: an open mesh for rendering and touching.

    Points are first averaged in cubes of half the radius, so that disks overlap without gaps where the cloud is denser
    than that, and each disk is moved onto the plane of its neighbours within 1.5 radii, which averages noise. Edges of
    the surface reach out by up to one radius, a curvature of radius R is flattened by about radius^2 / 2R, and points
    with hardly any neighbour are left out.

    Args:
        points: The cloud (n, 3) in metres.
        radius: Of the disks (m).
        normals: (n, 3) on whose side the disks face; a zero normal leaves its disk the plane's own.
        up: (3,) or (n, 3), the side that disks face without normals: where the camera was.

    Returns:
        The mesh of the disks.

    Raises:
        ValueError: No disk remains.
    """
    points = np.asarray(points, np.float64)
    side = np.broadcast_to(np.asarray(up, np.float64), points.shape) if normals is None else np.asarray(normals)
    _, cube = np.unique(np.floor(points / (radius / 2)).astype(np.int64), axis=0, return_inverse=True)
    cube = cube.reshape(-1)
    count = np.bincount(cube)[:, None]
    mean = np.stack([np.bincount(cube, v) for v in np.concatenate([points, side], 1).T], -1) / count
    centres, side = mean[:, :3], mean[:, 3:]

    near = min(MAX_FIT_NEIGHBOURS, len(centres))
    distance, index = cKDTree(centres).query(centres, k=np.arange(1, near + 1), distance_upper_bound=1.5 * radius)
    weight = np.isfinite(distance)[..., None]
    ring = centres[np.where(weight[..., 0], index, 0)]
    middle = (ring * weight).sum(1) / weight.sum(1)
    offset = (ring - middle[:, None]) * weight
    axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))[1]  # smallest spread first: the normal
    normal = axes[..., 0]
    normal = np.where((normal * side).sum(1, keepdims=True) < 0, -normal, normal)
    centres = centres - ((centres - middle) * normal).sum(1, keepdims=True) * normal

    kept = weight.sum((1, 2)) >= MIN_FIT_POINTS
    if not kept.any():
        raise ValueError(
            f"points: none has {MIN_FIT_POINTS - 1} others within 1.5 x {radius:g} m; give a larger radius or a "
            "denser cloud"
        )
    centres, normal = centres[kept], normal[kept]
    u = axes[kept, :, 2]
    v = np.cross(normal, u)
    angle = np.arange(6) * np.pi / 3
    corners = centres[:, None] + radius * (np.cos(angle)[:, None] * u[:, None] + np.sin(angle)[:, None] * v[:, None])
    fan = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    faces = (6 * np.arange(len(centres))[:, None, None] + fan).reshape(-1, 3)
    return Mesh(corners.reshape(-1, 3), faces.astype(np.int32))


def _ply(data: bytes) -> dict[str, NDArray]:
    """The vertex table of a PLY file."""
    mark = b"end_header"
    end = data.find(mark)
    if not data.startswith(b"ply") or end < 0:
        raise ValueError("it has no PLY header")
    lines = [line.split() for line in data[:end].decode("ascii").splitlines()]
    body = data[data.index(b"\n", end) + 1 :]
    form = next((line[1] for line in lines if line[:1] == ["format"]), "none")
    first = next((line for line in lines if line[:1] == ["element"]), [])
    if first[:2] != ["element", "vertex"]:
        raise ValueError("its first element is not the vertices")
    start = lines.index(first)
    stop = next((i for i in range(start + 1, len(lines)) if lines[i][:1] == ["element"]), len(lines))
    fields = [line[1:] for line in lines[start:stop] if line[:1] == ["property"]]
    if any(len(field) != 2 for field in fields):
        raise ValueError("its vertices have a list property")
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    return _table(body, [(name, PLY_TYPES[kind], 1) for kind, name in fields], int(first[2]), order)


def _pcd(data: bytes) -> dict[str, NDArray]:
    """The table of a PCD file of the Point Cloud Library, version 0.7."""
    header: dict[str, list[str]] = {}
    body = data
    while "DATA" not in header:
        line, newline, body = body.partition(b"\n")
        if not newline:
            raise ValueError("its header has no DATA line")
        words = line.decode("ascii").split()
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
    form = header["DATA"][0]
    if form == "binary_compressed":
        raise ValueError("it is compressed; save it as binary")
    order = {"ascii": "", "binary": "<"}[form]
    counts = header.get("COUNT", ["1"] * len(header["FIELDS"]))
    columns = zip(header["FIELDS"], header["TYPE"], header["SIZE"], counts, strict=True)
    fields = [(name, kind.lower() + size, int(count)) for name, kind, size, count in columns]
    return _table(body, fields, int(header["POINTS"][0]), order)


def _table(body: bytes, fields: list[tuple[str, str, int]], count: int, order: str) -> dict[str, NDArray]:
    """Columns of `count` rows, ASCII where the byte order is "", else binary; columns of several values are skipped."""
    widths = [width for _, _, width in fields]
    if count < 0:
        raise ValueError(f"it announces {count} points")
    if order:
        names = [f"{i}" for i in range(len(fields))]
        row = np.dtype([(n, order + kind, (width,)) for n, (_, kind, width) in zip(names, fields, strict=True)])
        if len(body) < count * row.itemsize:
            raise ValueError(f"it announces {count} points and ends after {len(body) // row.itemsize}")
        cells = np.frombuffer(body, row, count)
        columns = [cells[n][:, 0] for n in names]
    else:
        lines = body.decode("ascii").splitlines()[:count]
        if len(lines) < count:
            raise ValueError(f"it announces {count} points and ends after {len(lines)}")
        values = np.loadtxt(io.StringIO("\n".join(lines)), ndmin=2) if count else np.empty((0, sum(widths)))
        if values.shape[1] != sum(widths):
            raise ValueError(f"its rows have {values.shape[1]} values instead of {sum(widths)}")
        columns = [values[:, i] for i in np.cumsum([0, *widths[:-1]])]
    return {
        name: column.astype(np.float64) for (name, _, width), column in zip(fields, columns, strict=True) if width == 1
    }
