"""The surface of one object from touches that were recorded.

The mesh that is made may be named to `--objects` of recognition and of collection.
"""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float

from experiments.common.runs import begin, write_json
from experiments.reconstruct.arguments import ReconstructArgs
from experiments.reconstruct.report import shown_surface
from experiments.reconstruct.world import MM_PER_M, split_objects
from i2t import viz
from i2t.dataset import Dataset, load_dataset
from i2t.errors import DataError, did_you_mean
from i2t.files.writing import replacing
from i2t.geometry import inverse
from i2t.objects.solids import Mesh, place_on_table
from i2t.patches.dimensions import STANDOFF
from i2t.reconstruction.evidence import contact_evidence
from i2t.reconstruction.surface import SurfaceModel, estimate_surface, init, surface_model, update
from i2t.registration import contact_poses
from i2t.types import ReturnCode

MIN_CONTACTS = 3  # fewer say almost nothing of a shape
MAX_ACROSS_M, LOWEST_M = 0.35, 15e-3  # of contacts with one object that stands on z = 0
LEAST_WAY_M = 2e-3  # that a session's `prepare` may be
ROOM_M = 10e-3  # about the contacts, in which the surface is sought


def run(args: ReconstructArgs) -> dict[str, Any]:
    """Reconstruct an object from --dataset; write its mesh, a picture and metrics.json."""
    assert args.dataset is not None
    path, dataset = args.dataset, load_dataset(args.dataset, missing_chips=True)
    name = choose_object(dataset, args.object, path)
    T_o_t, hit = read_touches(dataset, name)
    model = prior_of(T_o_t[hit], args)
    begin(args, args.sizes)  # data that cannot be used leave no folder behind
    state, _ = init(model)
    way = swept_way(dataset)
    for pose, contact in zip(T_o_t, hit, strict=True):
        state, _ = update(model, state, contact_evidence(pose, hit=bool(contact), swept=way))
    estimate = estimate_surface(model, state)
    surface = shown_surface(estimate, state.evidence)
    if not len(surface.faces):
        raise DataError(f"{path}: no surface comes out of its {hit.sum()} contacts with {name}")
    std_mm = MM_PER_M * surface.std
    result = {
        "source": dataset.source,
        "object": name,
        "contacts": int(hit.sum()),
        "in_air": int((~hit).sum()),
        "surface_std_mm": {"median": float(np.median(std_mm)), "p90": float(np.quantile(std_mm, 0.9))},
        "library": model.library.size,
    }
    standing = place_on_table(Mesh(surface.vertices, surface.faces))
    result["frame_shift_mm"] = (MM_PER_M * (surface.vertices[0] - standing.vertices[0])).tolist()
    mesh_file = args.out / f"{args.name}.stl"
    with replacing(mesh_file) as temporary:
        trimesh.Trimesh(standing.vertices, standing.faces, process=False).export(temporary, file_type="stl")
    write_json(args.out / "metrics.json", result)
    title = f"{name} from {len(hit)} touches"
    figure = viz.plot_growing_surface([surface], None, title, dataset.source == "simulated")
    viz.save_figure(figure, args.out / "surface.png")
    report(result, mesh_file)
    return result


def choose_object(dataset: Dataset, wanted: str | None, path: Path) -> str:
    """The object of that name, or the only one (DataError)."""
    if wanted is None and len(dataset.objects) == 1:
        return dataset.objects[0]
    if wanted not in dataset.objects:
        problem = "holds several objects" if wanted is None else f"holds no touch of {wanted}"
        remedy = f"pass --object with one of {', '.join(sorted(dataset.objects))}"
        raise DataError(f"{path}: {problem}; {did_you_mean(wanted or '', dataset.objects, remedy)}")
    return wanted


class RecordedTouches(NamedTuple):
    """Touches of one object, in its frame."""

    T_o_t: np.ndarray  # (n, 4, 4) first contact, or where the way through air ended
    hit: np.ndarray  # (n,)


def read_touches(dataset: Dataset, name: str) -> RecordedTouches:
    """The touches of one object that met it or ended in air, in its frame as it was believed to stand (DataError)."""
    rows = dataset.touches.object == dataset.objects.index(name)
    touches = dataset.select(rows).touches
    T_w_t, hit = (np.asarray(part) for part in contact_poses(touches))
    placed = np.isfinite(touches.T_w_o).all((1, 2)) & np.isfinite(T_w_t).all((1, 2))
    kept = placed & (hit | (touches.code == ReturnCode.AIR))
    if not (kept & hit).sum() >= MIN_CONTACTS:
        raise DataError(
            f"{name}: {int((kept & hit).sum())} touches met it at known poses of tool and object; a surface "
            f"needs {MIN_CONTACTS} or more"
        )
    T_o_t = inverse(touches.T_w_o[kept].astype(float)) @ T_w_t[kept].astype(float)
    met = T_o_t[hit[kept], :3, 3]
    if not (
        np.ptp(met, axis=0).max() < MAX_ACROSS_M and met[:, 2].min() > -LOWEST_M and met[:, 2].max() < MAX_ACROSS_M
    ):
        raise DataError(
            f"{name}: contacts lie {np.ptp(met, axis=0).max():.2f} m apart, {met[:, 2].min():.2f} to "
            f"{met[:, 2].max():.2f} m above where it stands; check T_w_t, T_w_o and their units"
        )
    return RecordedTouches(T_o_t, hit[kept])


def swept_way(dataset: Dataset) -> float:
    """Metres before each contact that its pad surely swept in a straight line: as the notes of the sessions say, or the
    least that a session may have.
    """
    said = re.findall(r'"prepare": ([0-9.e-]+)', dataset.meta.get("settings", ""))
    return min(map(float, said), default=STANDOFF if dataset.source == "simulated" else LEAST_WAY_M)


def prior_of(contacts: Float[np.ndarray, "n 4 4"], args: ReconstructArgs) -> SurfaceModel:
    """Prior of the surface: random objects of the catalogue or those of --objects, on a grid about the contacts."""
    at = contacts[:, :3, 3]
    low, high = np.minimum(at.min(0) - ROOM_M, [-40e-3, -40e-3, 0.0]), np.maximum(at.max(0) + ROOM_M, [40e-3] * 3)
    return surface_model(list(split_objects(args, hold_out=False).train.values()), low=low, high=high)


def report(result: dict[str, Any], path: Path) -> None:
    """Say what came out, and what may be done with it."""
    std = result["surface_std_mm"]
    simulated = ", simulated" if result["source"] == "simulated" else ""
    print(
        f"{result['object']}: {result['contacts']} contacts and {result['in_air']} touches in air{simulated}; the "
        f"surface is known to {std['median']:.1f} mm (median standard deviation; of a tenth above {std['p90']:.1f})"
    )
    shift = ", ".join(f"{value:+.1f}" for value in result["frame_shift_mm"])
    print(
        f"{path} is in metres and stands as a loaded mesh does; its frame lies ({shift}) mm from the one in which the "
        "object was believed to stand: move the rig's object by that before it is touched again"
    )
    print(f"next: python -m experiments.recognize live --objects star cylinder {path} --unit m")
