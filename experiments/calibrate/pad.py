"""Fit of a pad to recorded presses of one tip. `i2t.load_pad` reads the file, and simulations use it."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from experiments.calibrate.arguments import CalibrateArgs
from experiments.calibrate.evaluate import explained
from experiments.train.sources import MIN_PAD_R2
from i2t import dataset as data
from i2t.dataset import Dataset
from i2t.recordings.diagnose import repeated_rows
from i2t.recordings.loads import loaded_presses
from i2t.skin_models.layer_fit import LayerPosterior
from i2t.skin_models.magnetic_layer import parse_tip
from i2t.skin_models.magnetization import MagnetizationModel, TipReadings
from i2t.types import Board

PARAMETER_UNITS = {  # printed unit of each parameter of the layer, and factor from SI units
    "thickness": ("mm", 1e3),
    "gap": ("mm", 1e3),
    "young": ("kPa", 1e-3),
    "poisson": ("", 1.0),
    "contact_offset": ("mm", 1e3),
    "mount_compliance": ("mm/N", 1e3),
    "tip_offset": ("mm", 1e3),
    "tip_scale": ("", 1.0),
    "board_offset": ("mm", 1e3),
    "board_rotation": ("deg", float(np.degrees(1.0))),
    "noise_std": ("uT", 1.0),
}


def run(args: CalibrateArgs, *, max_presses: int = 300, min_presses: int = 5) -> dict[str, Any]:
    """Fit a pad to random presses of a data set, by force if it was measured, and save it. More than `max_presses` add
    little to the map and cost time; fewer than `min_presses` do not determine it (ValueError).
    """
    assert args.dataset is not None
    assert args.save_pad is not None
    if args.save_pad.exists() and not args.overwrite:
        raise ValueError(f"{args.save_pad} exists; choose another --save-pad, or pass --overwrite")
    dataset = data.load_dataset(args.dataset, skin=args.skin_name)
    touches = dataset.touches
    load = args.load if args.load != "auto" else "force" if np.isfinite(touches.force).any() else "travel"
    recording = loaded_presses(dataset, load)
    new = np.flatnonzero(~repeated_rows(recording.readings))
    rows = np.random.default_rng(args.seed).permutation(new)[:max_presses]
    if len(rows) < min_presses:
        raise ValueError(f"{len(rows)} presses are too few to fit a pad to; give at least {min_presses}")
    tip = args.tip or tip_of(dataset) or dataset.objects[int(touches.object[0])]
    readings, board = recording.readings[rows], Board(*(jnp.float32(part) for part in dataset.board))
    position, load_of_press = jnp.float32(recording.position[rows]), jnp.float32(recording.load[rows])
    model = MagnetizationModel(parse_tip(tip), recording.by_force)
    fitted = model.fit(None, TipReadings(position, load_of_press, jnp.float32(readings), board))
    square = fitted.leave_one_place_out**2
    errors = fitted.leave_one_out, fitted.leave_one_place_out
    r2, r2_places = (explained(readings, (error**2).sum(1)) for error in errors)
    error_std = float(np.sqrt(np.mean(square)))
    layer = _ranges(fitted.posterior)
    about = {
        "pad": args.pad_name or dataset.pads[int(touches.pad[0])],
        "source": dataset.source,
        "presses": len(rows),
        "error_std_uT": error_std,
        "r2": r2,
        "r2_places": r2_places,
        "layer": layer,
        "converged": bool(fitted.posterior.converged),
    }
    fitted.save(args.save_pad, about)
    print(
        f'pad of "{about["pad"]}" fitted to {len(rows)} {dataset.source} presses of {tip} by {load}: R2 '
        f"{r2_places:.3f} ({error_std:.1f} uT) at places left out, {r2:.3f} for presses left out"
    )
    for name, (value, low, high) in layer.items():
        print(f"  {name:<28} {value:.4g} [{low:.4g}, {high:.4g}]")
    if not r2_places >= MIN_PAD_R2:
        print(
            "warning: this pad explains its own skin poorly, perhaps because the skin is not an even layer over this "
            "board; experiments.train --pad refuses it"
        )
    print(f"it is in {args.save_pad}")
    return {**about, "tip": tip}


def _ranges(posterior: LayerPosterior) -> dict[str, tuple[float, ...]]:
    """List value and 95 % range of each parameter except gains and strengths, by its name and unit."""
    rows = {}
    for name, (unit, factor) in PARAMETER_UNITS.items():
        ends = factor * np.stack([np.ravel(getattr(part, name)) for part in posterior[:3]], axis=1)
        for axis, row in zip("xyz" if len(ends) > 1 else ("",), ends, strict=False):
            rows[" ".join(word for word in (name, axis, f"({unit})" if unit else "") if word)] = tuple(map(float, row))
    return rows


def tip_of(dataset: Dataset) -> str | None:
    """Read the round tip of a data set, in the form of --tip; None if the tip is not round or not recorded."""
    name = dataset.objects[int(dataset.touches.object[0])]
    radius = dataset.meta.get("tip_radius_m")
    tip = name if radius is None else f"sphere:{1e3 * float(radius):g}"
    try:
        parse_tip(tip)
    except ValueError:
        return None
    return tip
