"""The surface of an object from the touches of a data set: one that was collected, or that recognition met and did not
know. The mesh that is made may be named to `--objects` of recognition and of collection.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.common.runs import begin, write_json
from experiments.reconstruct.arguments import ReconstructArgs
from experiments.reconstruct.figures import shown_surface
from experiments.reconstruct.live import explore
from experiments.reconstruct.scores import MM_PER_M, judge, true_shape
from experiments.reconstruct.world import split_objects
from i2t import viz
from i2t.dataset import Dataset, load_dataset
from i2t.errors import DataError
from i2t.files import replacing
from i2t.geometry import inverse
from i2t.objects.catalogue import NAMES, make_object
from i2t.objects.solids import Mesh, place_on_table
from i2t.reconstruction.surface import (
    SurfaceEstimate,
    SurfaceModel,
    SurfaceState,
    contact_evidence,
    estimate_surface,
    init,
    surface_model,
    update,
)
from i2t.registration.touch import contact_poses
from i2t.types import STANDOFF, ReturnCode

MIN_CONTACTS = 3  # fewer say almost nothing of a shape
ROOM_M = 10e-3  # about the contacts, in which the surface is sought


class RecordedTouches(NamedTuple):
    """Touches of one object, in its frame."""

    T_o_t: np.ndarray  # (n, 4, 4) first contact, or where the way through air ended
    hit: np.ndarray  # (n,)


def run(args: ReconstructArgs) -> dict[str, Any]:
    """Reconstruct an object from --dataset, or from what --arm touches; write its mesh, a picture and metrics.json."""
    if args.arm is not None:
        begin(args.out, args, args.sizes, None, args.overwrite)
    path = explore(args) if args.dataset is None else args.dataset
    dataset = load_dataset(path, missing_chips=True)
    name = choose_object(dataset, args.object, path)
    touches = read_touches(dataset, name)
    if args.arm is None:  # a data set that cannot be used leaves no folder behind
        begin(args.out, args, args.sizes, None, args.overwrite)
    model = prior_of(touches, args)
    state, estimate = reconstruct(model, touches)
    surface = shown_surface(estimate, state.touches)
    if not len(surface.faces):
        raise DataError(f"{path}: no surface comes out of its {touches.hit.sum()} contacts with {name}")
    std_mm = MM_PER_M * surface.std
    result = {
        "source": dataset.source,
        "object": name,
        "contacts": int(touches.hit.sum()),
        "in_air": int((~touches.hit).sum()),
        "surface_std_mm": {"median": float(np.median(std_mm)), "p90": float(np.quantile(std_mm, 0.9))},
        "library": model.library.shape[1],
    }
    there = args.true_object or name
    if dataset.source == "simulated" and there in NAMES:
        truth = true_shape(make_object(there).mesh, model.grid, args.sizes.samples)
        start = judge(estimate_surface(model, init(model)[0]), truth)
        result["against_the_catalogue"] = {"before": start, "after": judge(estimate, truth)}
    standing = place_on_table(Mesh(surface.vertices, surface.faces))
    result["frame_shift_mm"] = (MM_PER_M * (surface.vertices[0] - standing.vertices[0])).tolist()
    mesh_file = args.out / f"{args.name}.stl"
    write_stl(mesh_file, standing)
    write_json(args.out / "metrics.json", result)
    draw(args.out, surface, f"{name} from {len(touches.hit)} touches", dataset.source == "simulated")
    report(result, mesh_file)
    return result


def choose_object(dataset: Dataset, wanted: str | None, path: Path) -> str:
    """The object of that name, or the only one (DataError)."""
    if wanted is None and len(dataset.objects) == 1:
        return dataset.objects[0]
    if wanted not in dataset.objects:
        problem = "holds several objects" if wanted is None else f"holds no touch of {wanted}"
        raise DataError(f"{path}: {problem}; pass --object with one of {', '.join(sorted(dataset.objects))}")
    return wanted


def read_touches(dataset: Dataset, name: str) -> RecordedTouches:
    """The touches of one object that met it or ended in air, in its frame as it was believed to stand (DataError)."""
    rows = dataset.touches.object == dataset.objects.index(name)
    touches = dataset.select(rows).touches
    T_w_t, hit = (np.asarray(part) for part in contact_poses(touches))
    used = hit | (touches.code == ReturnCode.AIR)
    placed = np.isfinite(touches.T_w_o).all((1, 2)) & np.isfinite(T_w_t).all((1, 2))
    if not (used & placed & hit).sum() >= MIN_CONTACTS:
        raise DataError(
            f"{name}: {int((used & placed & hit).sum())} touches met it at known poses of tool and object; a surface "
            f"needs {MIN_CONTACTS} or more"
        )
    kept = used & placed
    return RecordedTouches(inverse(touches.T_w_o[kept].astype(float)) @ T_w_t[kept].astype(float), hit[kept])


def prior_of(touches: RecordedTouches, args: ReconstructArgs) -> SurfaceModel:
    """Prior of the surface: shapes of --meshes or of the catalogue's random objects, on a grid about the contacts."""
    met = touches.T_o_t[touches.hit]
    at = met[:, :3, 3]
    low, high = np.minimum(at.min(0) - ROOM_M, [-40e-3, -40e-3, 0.0]), np.maximum(at.max(0) + ROOM_M, [40e-3] * 3)
    split = split_objects(args, args.sizes)
    return surface_model([each.mesh for each in split.train], low=low, high=high)


def reconstruct(model: SurfaceModel, touches: RecordedTouches) -> tuple[SurfaceState, SurfaceEstimate]:
    """Reconstruct the surface from the contacts and the ways through air."""
    state, _ = init(model)
    for T_o_t, hit in zip(*touches, strict=True):
        state, _ = update(model, state, contact_evidence(T_o_t, hit=bool(hit), swept=STANDOFF))
    return state, estimate_surface(model, state)


def write_stl(path: Path, mesh: Mesh) -> None:
    """A mesh in metres, whole or not at all."""
    import trimesh

    with replacing(path) as temporary:
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(temporary, file_type="stl")


def draw(out: Path, surface: viz.ShownSurface, title: str, simulated: bool) -> None:
    """The surface, coloured by its standard deviation, with the poses that met it."""
    if reason := viz.write_surface_gltf(surface, out / "surface.gltf"):
        print(reason)
    viz.save_figure(viz.plot_growing_surface([surface], None, title, simulated), out / "surface.png")


def report(result: dict[str, Any], path: Path) -> None:
    """Say what came out, and what may be done with it."""
    std = result["surface_std_mm"]
    simulated = ", simulated" if result["source"] == "simulated" else ""
    print(
        f"{result['object']}: {result['contacts']} contacts and {result['in_air']} touches in air{simulated}; the "
        f"surface is known to {std['median']:.1f} mm (median standard deviation; a tenth worse than {std['p90']:.1f})"
    )
    if found := result.get("against_the_catalogue"):
        before, after = found["before"], found["after"]
        print(
            f"against the catalogue's mesh: Chamfer distance {after['chamfer_mm']:.2f} mm "
            f"({before['chamfer_mm']:.2f} before the first touch), IoU {after['iou']:.2f} ({before['iou']:.2f})"
        )
    shift = ", ".join(f"{value:+.1f}" for value in result["frame_shift_mm"])
    print(
        f"{path} is in metres and stands as a loaded mesh does; its frame lies ({shift}) mm from the one in which the "
        "object was believed to stand: move the rig's object by that before it is touched again"
    )
    print(f"next: python -m experiments.recognize live --objects star cylinder {path} --unit m")
