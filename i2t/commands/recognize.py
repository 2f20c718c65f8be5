"""Recognise the objects of recorded sessions: `i2t recognize` prints the most probable object of each.

    i2t recognize nominal                        the simulated touches that come with i2t
    i2t recognize DATA --pad-model runs/mine     a pad model of your own skin, which `i2t fit` wrote
    i2t recognize DATA --pad-model runs/mine --objects mug.stl:mm bowl.stl:mm star

In each session, one object was touched at one place of the table. Touches need forces, tool poses, and the believed
pose of the object, whose uncertainty --rig gives. The candidates are the objects of the data set, or --objects.
Sessions to which the pad model was fitted do not count in the rate. A pad model of another skin is refused, because
every skin differs. In a checkout, `python -m experiments.recognize` scores the beliefs and recognises with an arm.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from i2t.cli.exit_codes import command
from i2t.cli.options import Count, Seed, docstring_of, require_path
from i2t.errors import printable
from i2t.models.checks import require_dataset
from i2t.models.finished import find_pad_model, require_pad_model
from i2t.objects.named import meshes_of_dataset, read_meshes, require_objects


@dataclass(frozen=True)
class RecognizeArgs:
    """Recognise the objects of recorded sessions."""

    dataset: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")]
    """Folder or file of touches, or nominal, the simulated touches that come with i2t."""
    pad_model: Path = Path("nominal")
    """Pad model of the skin: folder of a fit, file, or nominal, of the simulated pad of the data set nominal."""
    objects: tuple[Path, ...] = ()
    """Objects to distinguish: names in the catalogue or mesh files. By default, those of the data set."""
    unit: Literal["m", "cm", "mm", "inch"] | None = None
    """Unit of the mesh files."""
    rig: Path | None = None
    """Description of the lab, whose object_covariance gives the pose errors; otherwise 1 mm and 1 degree."""
    touches: Count | None = None
    """Touches of each session; by default as many as all long enough sessions have."""
    poses: Count = 64
    """Poses of each object that are tried."""
    skin_name: str | None = None
    """Skin to use, if each touch has readings of several."""
    other_skin: bool = False
    """Allow touches of another skin than the pad model's."""
    seed: Seed = 0
    """Seed of the poses."""


def _recognize(args: RecognizeArgs) -> None:
    require_dataset("DATASET", args.dataset)
    require_objects(args.objects, args.unit)
    require_path("--rig", args.rig, "file")
    require_pad_model(args.pad_model)
    file, _ = find_pad_model(args.pad_model)
    from i2t.dataset import load_dataset
    from i2t.hardware.rig import Rig
    from i2t.recognition.recognizer import RecognizerConfig
    from i2t.recognition.recorded import describe
    from i2t.recognition.sessions import recognize, require_objects_touched
    from i2t.skin_models.pad_model import load_pad_model

    dataset, pad_model = load_dataset(args.dataset, skin=args.skin_name), load_pad_model(file)
    require_objects_touched(dataset, str(args.dataset))
    meshes = read_meshes(args.objects, args.unit) or meshes_of_dataset(dataset.objects, str(args.dataset))
    print(printable(describe(pad_model)))
    rig = Rig() if args.rig is None else Rig.read(args.rig)
    result = recognize(
        meshes, dataset, pad_model, covariance=rig.object_covariance, touches=args.touches, other_skin=args.other_skin,
        config=RecognizerConfig(num_particles=args.poses, seed=args.seed),
    )  # fmt: skip
    print(result.table())


main = command(RecognizeArgs, _recognize, program="i2t recognize", description=docstring_of("i2t.commands.recognize"))


if __name__ == "__main__":
    sys.exit(main())
