"""Imagine touches: `python -m i2t.imagine` draws what a skin would read where it touches an object.

    python -m i2t.imagine                                the hammer of the catalogue, by the ready model
    python -m i2t.imagine mug.stl --unit mm              an object of your own
    python -m i2t.imagine star --model runs/train        a predictor of your own

Safe sites of the object are drawn at random, the patch in front of the skin is rendered there, and a trained predictor
turns patch and force into readings with their standard deviations. The ready model is of one simulated pad
(docs/model_card.md): it shows what a touch looks like, and no real skin reads as it does.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from i2t.cli.exit_codes import command
from i2t.cli.options import Count, Limits, Seed, docstring_of, require_writable
from i2t.models import READY_MODELS, ready_hint, ready_path
from i2t.objects.named import read_object
from i2t.patches.dimensions import MAX_SKIN_FORCE_N

if TYPE_CHECKING:
    from i2t.objects import Object
    from i2t.prediction.predictor import Predictor
    from i2t.types import Board


PICTURE_ENDINGS = (".png", ".jpg", ".pdf", ".svg")
CHECKPOINT_NOTE = "_CHECKPOINT_METADATA"  # in the folder of every predictor


@dataclass(frozen=True)
class ImagineArgs:
    """Draw what a skin would read where it touches an object."""

    object: tyro.conf.Positional[str] = "hammer"
    """A name of the catalogue, or a mesh file."""
    unit: Literal["m", "cm", "mm", "inch"] | None = None
    """Of a mesh file."""
    model: str = "nominal"
    """The ready model, or a finished run of experiments.train."""
    board: str | None = None
    """Of the skin: reskin, anyskin, eflesh, grid-RxC for R rows and C columns of chips, or a board file (.toml); by
    default the board that the model was trained on."""
    force: Annotated[float, Limits(0, MAX_SKIN_FORCE_N, above=True)] = 1.0
    """N along the tool's z axis."""
    sites: Count = 4
    """Touches to imagine."""
    seed: Seed = 0
    """Of the sites."""
    out: Path = Path("runs/imagine.png")
    """The picture, such as a .png file; one that is there is replaced."""


def _imagine(asked: ImagineArgs) -> None:
    _check(asked)
    thing = _object(asked)
    from i2t import viz
    from i2t.dataset import holds_simulated
    from i2t.prediction.predictor import load_predictor
    from i2t.rendering.render import prepare_surface
    from i2t.simulation.sites import sample_touch_sites

    predictor = load_predictor(asked.model)
    board = _board(asked, predictor)
    surface = prepare_surface(thing.mesh)
    sites = sample_touch_sites(surface, asked.sites, seed=asked.seed, name=thing.name)
    seen = predictor.render_touches(surface, sites.T_o_t)
    readings = predictor.predict(seen, force=asked.force)
    for number, (mean, std) in enumerate(zip(readings.mean, readings.std, strict=True), 1):
        chip, axis = divmod(int(abs(mean).argmax()), 3)
        strongest = f"{mean[3 * chip + axis]:.1f} +- {std[3 * chip + axis]:.1f} uT"
        print(f"touch {number}: chip {chip} {'xyz'[axis]} changes most, by {strongest}")
    simulated = asked.model in READY_MODELS or holds_simulated((predictor.metadata or {}).get("source", "simulated"))
    figure = viz.plot_predicted_touches(
        seen.patch, {"imagined": readings.mean}, [f"touch {i + 1}" for i in range(asked.sites)], board,
        title=f"{thing.name}, pressed with {asked.force:g} N", simulated=simulated,
    )  # fmt: skip
    print(f"wrote {viz.save_figure(figure, asked.out)}")


def _check(asked: ImagineArgs) -> None:
    """Refuse wrong options before JAX is imported."""
    if asked.out.is_dir():
        raise ValueError(f"--out {asked.out}: is a folder; name the picture, such as {asked.out / 'touches.png'}")
    require_writable("--out", asked.out)
    if asked.out.suffix.lower() not in PICTURE_ENDINGS:
        raise ValueError(f"--out {asked.out}: is no name of a picture; let it end in {' or '.join(PICTURE_ENDINGS)}")
    folder = ready_path(asked.model, "predictor")
    if not any((folder / part / CHECKPOINT_NOTE).is_file() for part in ("", "checkpoint/predictor")):
        raise ValueError(
            f"--model {asked.model}: holds no predictor; name the folder that `python -m experiments.train` wrote"
            + ready_hint(asked.model, "predictor")
        )
    if asked.board is not None:
        from i2t.skin.boards import make_board

        make_board(asked.board)


def _board(asked: ImagineArgs, predictor: "Predictor") -> "Board":
    """The board that the predictor was trained on, or where that is not known one of as many values."""
    from i2t.skin.boards import DEFAULT_BOARD, make_board, name_of_board, same_board

    trained_on, name = predictor.board, asked.board or DEFAULT_BOARD
    if trained_on is not None and asked.board is None:
        return trained_on
    board = make_board(name)
    if predictor.model.channels != board.num_readings:
        raise ValueError(
            f"--board {name} has {board.num_readings} values, and the predictor of {asked.model} has "
            f"{predictor.model.channels}; name the board that it was trained on"
        )
    if trained_on is None:
        print(f"the predictor of {asked.model} does not say its board; its readings are drawn at the chips of {name}")
    elif not same_board(board, trained_on):
        its = name_of_board(trained_on) or "another board of as many chips"
        raise ValueError(
            f"--board {name} is another board than that of the predictor of {asked.model}, {its}: its readings are of "
            "those chips; leave --board out, or train on touches of this board"
        )
    return board


def _object(asked: ImagineArgs) -> "Object":
    """Object to touch, by its name or from its file."""
    from i2t.objects.catalogue import NAMES

    if asked.object in NAMES and asked.unit is not None:
        raise ValueError("--unit is of a mesh file, and an object of the catalogue needs none; leave it out")
    return read_object(asked.object, asked.unit)


main = command(ImagineArgs, _imagine, program="python -m i2t.imagine", description=docstring_of("i2t.imagine"))


if __name__ == "__main__":
    sys.exit(main())
