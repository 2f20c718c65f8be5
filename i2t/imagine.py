"""Predict touches: `i2t imagine` draws the readings of a skin where it would touch an object.

    i2t imagine                                the hammer of the catalogue, by the ready model
    i2t imagine mug.stl --unit mm              an object of your own
    i2t imagine star --model runs/train        a predictor of your own

Safe sites on the object are drawn at random. The patch in front of the skin is rendered there, and a trained predictor
computes readings and their standard deviations from patch and force. The ready model was trained on a simulated pad
(docs/model_card.md). It shows what a touch looks like; the readings of a real skin differ.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from i2t.cli.exit_codes import command
from i2t.cli.options import Count, Limits, Seed, docstring_of, require_writable
from i2t.files.checkpoints import is_checkpoint
from i2t.installation import training_command
from i2t.models import READY_MODELS, ready_hint, ready_path
from i2t.objects.named import read_object
from i2t.patches.dimensions import MAX_SKIN_FORCE_N

if TYPE_CHECKING:
    from i2t.objects import Object
    from i2t.prediction.predictor import Predictor
    from i2t.types import Board


@dataclass(frozen=True)
class ImagineArgs:
    """Draw the predicted readings of a skin where it would touch an object."""

    object: tyro.conf.Positional[str] = "hammer"
    """Name of the object in the catalogue, or a mesh file."""
    unit: Literal["m", "cm", "mm", "inch"] | None = None
    """Unit of the mesh file; required for a mesh file."""
    model: str = "nominal"
    """Predictor: the name of the ready model, or the folder in which a predictor was trained."""
    # board of the skin: reskin, anyskin, eflesh, grid-RxC for R rows and C columns of chips, or a board file (.toml);
    # by default, the board that the model was trained on
    board: str | None = None
    force: Annotated[float, Limits(0, MAX_SKIN_FORCE_N, above=True)] = 1.0
    """Force (N) of the press along the tool's z axis."""
    sites: Count = 4
    """Number of touches to predict, each at another site."""
    seed: Seed = 0
    """Seed of the random sites."""
    out: Path = Path("runs/imagine.png")
    """Picture to write, such as a .png file; an existing file is replaced."""


def _imagine(args: ImagineArgs) -> None:
    _check(args)
    target = _object(args)
    from i2t import viz
    from i2t.dataset import holds_simulated
    from i2t.prediction.predictor import load_predictor
    from i2t.rendering.render import prepare_surface
    from i2t.simulation.sites import sample_touch_sites

    predictor = load_predictor(args.model)
    board = _board(args, predictor)
    surface = prepare_surface(target.mesh)
    sites = sample_touch_sites(surface, args.sites, seed=args.seed, name=target.name)
    seen = predictor.render_touches(surface, sites.T_o_t)
    readings = predictor.predict(seen, force=args.force)
    for number, (mean, std) in enumerate(zip(readings.mean, readings.std, strict=True), 1):
        chip, axis = divmod(int(abs(mean).argmax()), 3)
        strongest = f"{mean[3 * chip + axis]:.1f} +- {std[3 * chip + axis]:.1f} uT"
        print(f"touch {number}: chip {chip} {'xyz'[axis]} changes most, by {strongest}")
    simulated = args.model in READY_MODELS or holds_simulated((predictor.metadata or {}).get("source", "simulated"))
    figure = viz.plot_predicted_touches(
        seen.patch, {"imagined": readings.mean}, [f"touch {i + 1}" for i in range(args.sites)], board,
        title=f"{target.name}, pressed with {args.force:g} N", simulated=simulated,
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
    folder = ready_path(args.model, "predictor")
    if not any(is_checkpoint(folder / part) for part in ("", "checkpoint/predictor")):
        raise ValueError(
            f"--model {args.model}: holds no predictor; name the folder that `{training_command()}` wrote"
            + ready_hint(args.model, "predictor")
        )
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


def _object(args: ImagineArgs) -> "Object":
    """Read the object to touch, by its name or from its file."""
    from i2t.objects.catalogue import NAMES

    if args.object in NAMES and args.unit is not None:
        raise ValueError("--unit is for mesh files, but the object is from the catalogue; leave it out")
    return read_object(args.object, args.unit)


main = command(ImagineArgs, _imagine, program="python -m i2t.imagine", description=docstring_of("i2t.imagine"))


if __name__ == "__main__":
    sys.exit(main())
