"""Predict touches: `i2t imagine` draws the readings of a skin where it would touch an object.

    i2t imagine                                the hammer of the catalogue, by the ready model
    i2t imagine mug.stl --unit mm              an object of your own
    i2t imagine star --model runs/train        a predictor of your own
    i2t imagine mug.stl:mm --at -17 20 44       one touch at a place (mm)

Of random safe sites on the object, those are touched whose patches differ most: flat, an edge, curved, a ridge, a tip.
A patch is the depth of the surface in front of the skin. From patch and force, a trained predictor computes the reading
at each chip, with standard deviations. The ready model was trained on a simulated pad
(docs/model_card.md). It shows what a touch looks like; the readings of a real skin differ.
"""

import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from i2t.cli.exit_codes import command
from i2t.cli.options import Count, Limits, Seed, docstring_of, require_writable
from i2t.models import READY_MODELS
from i2t.models.checks import require_predictor
from i2t.objects.named import describe_placement, read_object
from i2t.patches.dimensions import MAX_SKIN_FORCE_N

if TYPE_CHECKING:
    from i2t.objects import Mesh, Object
    from i2t.prediction.predictor import Predictor
    from i2t.prediction.touch_model import TouchBatch
    from i2t.types import Board, Surface


@dataclass(frozen=True)
class ImagineArgs:
    """Draw the predicted readings of a skin where it would touch an object."""

    object: tyro.conf.Positional[str] = "hammer"
    """Name of the object in the catalogue, or a mesh file."""
    unit: Literal["m", "cm", "mm", "inch"] | None = None
    """Unit of the mesh file, if its name has none (mug.stl:mm); glTF is in metres."""
    model: str = "nominal"
    """Predictor: the name of the ready model, or the folder in which a predictor was trained."""
    # board of the skin: reskin, anyskin, eflesh, grid-RxC for R rows and C columns of chips, or a board file (.toml);
    # by default, the board that the model was trained on
    board: str | None = None
    force: Annotated[float, Limits(0, MAX_SKIN_FORCE_N, above=True)] | None = None
    """Force (N) of the press along the tool's z axis; by default 1 N."""
    travel: Annotated[float, Limits(0, 20, above=True)] | None = None
    """Travel (mm) past first contact, for a predictor of presses by travel; by default the median of its training."""
    at: tuple[float, float, float] | None = None
    """Place (mm) of the only touch, in the frame of the printed places."""
    sites: Count | None = None
    """Number of touches to predict, at sites whose patches differ most; by default 4."""
    seed: Seed = 0
    """Seed of the random sites among which the touches are chosen."""
    out: Path = Path("runs/imagine.png")
    """Picture to write, such as a .png file; an existing file is replaced."""


def _imagine(args: ImagineArgs) -> None:
    _check(args)
    target = _object(args)
    if placement := describe_placement(target):
        print(placement)
    from i2t import viz
    from i2t.prediction.predictor import load_predictor
    from i2t.rendering.render import prepare_surface

    predictor = load_predictor(args.model)
    board = _board(args, predictor)
    surface = prepare_surface(target.mesh)
    given, load = _load(args, predictor)
    if args.at is None:
        T_o_t = _sites(args, predictor, surface, target.name)
        seen = predictor.render_touches(surface, T_o_t)
    else:
        T_o_t, seen = _touch_at(args.at, predictor, surface, target.mesh)
    readings = predictor.predict(seen, **given)
    kinds = [_kind(patch, predictor.window, predictor.reach) for patch in seen.patch]
    for number, (kind, T, mean, std) in enumerate(zip(kinds, T_o_t, *readings, strict=True), 1):
        x, y, z = (round(1e3 * float(metres)) for metres in T[:3, 3])
        print(f"touch {number} ({kind}) at ({x}, {y}, {z}) mm: {_strongest(board, mean, std)}")
    simulated = args.model in READY_MODELS or predictor.simulated
    figure = viz.plot_predicted_touches(
        seen.patch, {"predicted": readings.mean}, kinds, board,
        f"{target.name}: predicted touches, {load}", simulated,
        std={"predicted": readings.std}, mesh=target.mesh, T_o_t=T_o_t,
        window=predictor.window, reach=predictor.reach,
    )  # fmt: skip
    print(f"wrote {viz.save_figure(figure, args.out)}")


def _check(args: ImagineArgs) -> None:
    """Refuse wrong options before JAX is imported."""
    if args.out.is_dir():
        raise ValueError(f"--out {args.out}: is a folder; name the picture, such as {args.out / 'touches.png'}")
    require_writable("--out", args.out)
    endings = (".png", ".jpg", ".pdf", ".svg")
    if args.out.suffix.lower() not in endings:
        raise ValueError(f"--out {args.out}: is not the name of a picture; use the ending {' or '.join(endings)}")
    if args.at is not None and args.sites is not None:
        raise ValueError("--at names the only touch; leave --sites out")
    require_predictor("--model", args.model)
    if args.board is not None:
        from i2t.skin.boards import make_board

        make_board(args.board)


def _board(args: ImagineArgs, predictor: "Predictor") -> "Board":
    """Choose the board that the predictor was trained on, or, if that is unknown, a board with the same number of
    values.
    """
    from i2t.skin.boards import DEFAULT_BOARD, make_board, name_of_board, same_board

    trained_on, name = predictor.board, args.board or DEFAULT_BOARD
    if trained_on is not None and args.board is None:
        return trained_on
    board = make_board(name)
    if predictor.model.channels != board.num_readings:
        raise ValueError(
            f"--board {name} has {board.num_readings} values, and the predictor of {args.model} has "
            f"{predictor.model.channels}; name the board that it was trained on"
        )
    if trained_on is None:
        print(f"the predictor of {args.model} does not name its board; its readings are drawn at the chips of {name}")
    elif not same_board(board, trained_on):
        other = name_of_board(trained_on) or "another board with the same number of chips"
        raise ValueError(
            f"--board {name} differs from the board of the predictor of {args.model}, {other}; leave --board out, or "
            "train on touches of this board"
        )
    return board


def _load(args: ImagineArgs, predictor: "Predictor") -> tuple[dict[str, Any], str]:
    """Choose the load of the presses, as an argument of `Predictor.predict` and in words."""
    if predictor.load == "force":
        if args.travel is not None:
            raise ValueError(f"--travel: the predictor of {args.model} was fitted to presses by force; give --force")
        force = 1.0 if args.force is None else args.force
        return {"force": force}, f"{force:g} N"
    if args.force is not None:
        raise ValueError(
            f"--force: the predictor of {args.model} was fitted to presses by travel; give --travel, in mm"
        )
    travel = 1e3 * predictor.default_travel if args.travel is None else args.travel
    load = f"{travel:.2g} mm travel"
    print(f"the predictor of {args.model} was fitted to presses by travel; all touches have {load}")
    return {"travel": 1e-3 * travel}, load


def _touch_at(
    place: tuple[float, float, float], predictor: "Predictor", surface: "Surface", mesh: "Mesh"
) -> tuple[np.ndarray, "TouchBatch"]:
    """Find the (1, 4, 4) tool pose at a place (mm), and render what the skin meets there."""
    from i2t.objects.poses import contact_pose

    try:
        T_o_t = contact_pose(mesh, 1e-3 * np.asarray(place))[None]
        return T_o_t, predictor.render_touches(surface, T_o_t)
    except ValueError as error:
        reason = str(error).removeprefix("point: ").partition(";")[0]
        raise ValueError(
            f"--at {' '.join(f'{mm:g}' for mm in place)}: {reason}; give another place on the surface, in mm and in "
            "the frame of the printed places"
        ) from error


def _sites(args: ImagineArgs, predictor: "Predictor", surface: "Surface", name: str, pool: int = 64) -> np.ndarray:
    """Choose the sites whose patches differ most among a pool of random safe ones, as (n, 4, 4) tool poses."""
    import jax

    from i2t.simulation.sites import collect_sites

    accepted, patches, refused, sites = [], [], None, 4 if args.sites is None else args.sites
    drawn = collect_sites(jax.random.key(args.seed), surface, max(pool, sites), name=name, enough=sites)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the predictor warns about the chosen sites when they are rendered again
        for T in drawn:
            try:
                patches.append(predictor.render_touches(surface, T).patch[0])
            except ValueError as error:
                refused = error
            else:
                accepted.append(T)
    if refused is not None and len(accepted) < sites:
        raise refused
    T_o_t = np.stack(accepted)
    kinds = [_kind(patch, predictor.window, predictor.reach) for patch in patches]
    return T_o_t[_most_different(np.stack(patches), kinds, T_o_t[:, :3, 3], sites)]


def _most_different(
    patches: np.ndarray, kinds: list[str], points: np.ndarray, n: int, weight: float = 0.05
) -> list[int]:
    """Choose n of the (m, rows, columns) patches (m) of m kinds at (m, 3) points (m): first the flattest, and then one
    by one the patch that differs most from all chosen ones, of another kind if there is one.

    Patches are compared by their sorted depths, which do not change when the skin turns about its normal. A distance as
    long as the object counts as `weight` times the largest depth of a patch, so that equal patches are spread out.
    """
    depths, deepest = np.sort(patches.reshape(len(patches), -1), axis=1), max(float(patches.max()), 1e-6)
    is_kind = np.equal.outer(kinds, sorted(set(kinds)))
    spread = weight / max(float(np.ptp(points, axis=0).max()), 1e-9)
    features = np.hstack([depths / np.sqrt(depths.shape[1]), deepest * is_kind, deepest * spread * points])
    chosen = [int(depths.mean(1).argmin())]
    while len(chosen) < n:
        distances = np.linalg.norm(features[:, None] - features[chosen], axis=-1).min(1)
        distances[chosen] = -1
        chosen.append(int(distances.argmax()))
    return chosen


def _kind(patch: np.ndarray, window: float, reach: float) -> str:
    """Describe the surface in a patch (m) by the region that is within an eighth of the reach (0.5 mm) of its nearest
    point, and by the steps along its boundary.
    """
    near, pitch = patch <= patch.min() + reach / 8, window / len(patch)
    at = pitch * (np.argwhere(near) - (len(patch) - 1) / 2)  # m, from the middle of the patch
    centre, spread = at.mean(0), (at - at.mean(0)).T @ (at - at.mean(0)) / len(at)
    width, length = np.sqrt(12 * np.linalg.eigvalsh(spread))  # of a rectangle of the same spread
    boundary = [np.diff(near, axis=axis) for axis in (0, 1)]  # pairs of pixels of which one is near
    steps = np.concatenate([abs(np.diff(patch, axis=axis)[pairs]) for axis, pairs in enumerate(boundary)])
    if near.mean() > 0.9:
        return "flat"
    if length < window / 2:
        return "tip"
    if width < window / 4 and np.linalg.norm(centre) < window / 4:
        return "ridge"
    return "edge" if np.mean(steps > reach / 12) > 0.2 else "curved"


def _strongest(board: "Board", mean: np.ndarray, std: np.ndarray) -> str:
    """Describe the largest change of a predicted reading, in the axes that the picture shows."""
    field = board.to_tool(mean)
    chip, axis = divmod(int(abs(field).argmax()), 3)
    spread = np.sqrt(board.rotations[chip] ** 2 @ std.reshape(-1, 3)[chip] ** 2)[axis]
    value = field[chip, axis]
    if axis == 2:
        value, along = abs(value), "out of the skin" if value > 0 else "into the skin"
    else:
        along = f"along {'xy'[axis]}"
    return f"chip {chip} changes most, by {value:.1f} +- {spread:.1f} uT {along}"


def _object(args: ImagineArgs) -> "Object":
    """Read the object to touch, by its name or from its file."""
    from i2t.objects.catalogue import NAMES

    if args.object in NAMES and args.unit is not None:
        raise ValueError("--unit is for mesh files, but the object is from the catalogue; leave it out")
    return read_object(args.object, args.unit)


main = command(ImagineArgs, _imagine, program="python -m i2t.imagine", description=docstring_of("i2t.imagine"))


if __name__ == "__main__":
    sys.exit(main())
