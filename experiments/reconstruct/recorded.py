"""Reconstruction of one object from recorded touches.

The resulting mesh can be passed to `--objects` of recognition and of collection.
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

MIN_CONTACTS = 3
MAX_OBJECT_SIZE_M = 0.35
MIN_APPROACH_M = 2e-3  # smallest `prepare` distance that a session allows


def run(args: ReconstructArgs) -> dict[str, Any]:
    """Reconstruct an object from --dataset; write its mesh, a picture and metrics.json."""
    assert args.dataset is not None
    path, dataset = args.dataset, load_dataset(args.dataset, missing_chips=True)
    name = choose_object(dataset, args.object, path)
    T_o_t, hit = read_touches(dataset, name)
    model = prior_of(T_o_t[hit], args)
    begin(args, args.sizes)  # after the checks, so that unusable data leave no folder
    state, _ = init(model)
    swept = swept_distance(dataset)
    for pose, contact in zip(T_o_t, hit, strict=True):
        state, _ = update(model, state, contact_evidence(pose, hit=bool(contact), swept=swept))
    estimate = estimate_surface(model, state)
    surface = shown_surface(estimate, state.evidence)
    if not len(surface.faces):
        raise DataError(f"{path}: its {hit.sum()} contacts with {name} give no surface")
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
    """Return the wanted object's name, or the only one of the data set; `DataError` if that fails."""
    if wanted is None and len(dataset.objects) == 1:
        return dataset.objects[0]
    if wanted not in dataset.objects:
        problem = "holds several objects" if wanted is None else f"holds no touch of {wanted}"
        remedy = f"pass --object with one of {', '.join(sorted(dataset.objects))}"
        raise DataError(f"{path}: {problem}; {did_you_mean(wanted or '', dataset.objects, remedy)}")
    return wanted


class RecordedTouches(NamedTuple):
    """Touches of one object, in its frame."""

    T_o_t: np.ndarray  # (n, 4, 4) pose of first contact, or at the end of a path through air
    hit: np.ndarray  # (n,) bool


def read_touches(dataset: Dataset, name: str) -> RecordedTouches:
    """Select touches that hit an object or ended in air, in its nominal frame; `DataError` if too few or far off."""
    rows = dataset.touches.object == dataset.objects.index(name)
    touches = dataset.select(rows).touches
    T_w_t, hit = (np.asarray(part) for part in contact_poses(touches))
    placed = np.isfinite(touches.T_w_o).all((1, 2)) & np.isfinite(T_w_t).all((1, 2))
    kept = placed & (hit | (touches.code == ReturnCode.AIR))
    if not (kept & hit).sum() >= MIN_CONTACTS:
        raise DataError(
            f"{name}: {int((kept & hit).sum())} touches hit it at known poses of tool and object; a surface "
            f"needs {MIN_CONTACTS} or more"
        )
    T_o_t = inverse(touches.T_w_o[kept].astype(float)) @ T_w_t[kept].astype(float)
    met = T_o_t[hit[kept], :3, 3]
    if not (
        np.ptp(met, axis=0).max() < MAX_OBJECT_SIZE_M
        and met[:, 2].min() > -15e-3
        and met[:, 2].max() < MAX_OBJECT_SIZE_M
    ):
        raise DataError(
            f"{name}: contacts span {np.ptp(met, axis=0).max():.2f} m, at heights of {met[:, 2].min():.2f} to "
            f"{met[:, 2].max():.2f} m above the object's base; check T_w_t, T_w_o and their units"
        )
    return RecordedTouches(T_o_t, hit[kept])


def swept_distance(dataset: Dataset) -> float:
    """Straight approach (m) before each contact: the sessions' smallest setting, or else the smallest allowed."""
    distances = re.findall(r'"prepare": ([0-9.e-]+)', dataset.meta.get("settings", ""))
    return min(map(float, distances), default=STANDOFF if dataset.source == "simulated" else MIN_APPROACH_M)


def prior_of(contacts: Float[np.ndarray, "n 4 4"], args: ReconstructArgs) -> SurfaceModel:
    """Build the prior from random catalogue objects or --objects, on a grid that extends 10 mm beyond the contacts."""
    at = contacts[:, :3, 3]
    low, high = np.minimum(at.min(0) - 10e-3, [-40e-3, -40e-3, 0.0]), np.maximum(at.max(0) + 10e-3, [40e-3] * 3)
    return surface_model(list(split_objects(args, hold_out=False).train.values()), low=low, high=high)


def report(result: dict[str, Any], path: Path) -> None:
    """Print the result and the next step."""
    std = result["surface_std_mm"]
    simulated = ", simulated" if result["source"] == "simulated" else ""
    print(
        f"{result['object']}: {result['contacts']} contacts and {result['in_air']} touches in air{simulated}; the "
        f"surface has a median standard deviation of {std['median']:.1f} mm (90th percentile {std['p90']:.1f} mm)"
    )
    shift = ", ".join(f"{value:+.1f}" for value in result["frame_shift_mm"])
    print(
        f"{path} is in metres, in the frame of a loaded mesh, which is offset by ({shift}) mm from the object's "
        "nominal frame: move the rig's object by that before the next touch"
    )
    print(f"next: python -m experiments.recognize live --objects star cylinder {path} --unit m")
