"""Table of the README: results on real data and in simulation, and limits."""

import re
from collections.abc import Mapping

from experiments.common.cells import Measured, at
from experiments.common.tables import cell, markdown
from tools.reproduce.shape_tables import LEAD
from tools.reproduce.skin_tables import r2_of

GP = "Gaussian process on predicted contact pressure"
CALIBRATED = "i2t.calibrate"
VOTES = {
    "masks": "Imagine2touch (paper's network, mask), votes",
    "depths": "Imagine2touch (paper's network, depth), votes",
    "proprioception": "proprioception, votes",
}


def summary(results: Mapping[str, Measured]) -> str:
    """Table with a row for each function of i2t and links to the sources of its numbers; `results` is by step."""
    rows = [*_skins(results), *_objects(results), *_others(results)]
    table = markdown(["task", "real data", "simulated", "limits"], rows)
    return re.sub(r"\b0(?=\.\d\d\b)", "", table)  # .94 in place of 0.94


def _skins(results: Mapping[str, Measured]) -> list[list[str]]:
    blocks, study, calibrate = results["train_blocks"], results["study"], results["calibrate"]
    real, pads, registered = blocks["methods"], study["over_pads"], results["train_registered"]["over_pads"]
    by_position = next(scores for name, scores in real.items() if name.startswith(CALIBRATED))
    baseline = max(
        (real[name] for name in (*blocks["baselines"], "tuned GP on position and load")),
        key=lambda scores: scores["r2"],
    )
    baseline_on_pads = max((pads[name]["r2"] for name in study["baselines"]), key=lambda r2: r2[0])
    press = calibrate["calibrate_over_blocks"]["blocks of 6 mm"]["r2"]["20"]
    plain = calibrate["r2"]["blocks of 6 mm"]["plain Gaussian process"]["20"]["mean"]
    return [
        [
            "predict readings, R²",
            f"one eFlesh skin and tip, blocks held out: `{CALIBRATED}`, given the tip's position, "
            f"{r2_of(2, by_position)}; from an image {r2_of(2, real[GP])}; best baseline {r2_of(2, baseline)} "
            "([results](docs/results.md#real-presses-whole-blocks-held-out))",
            f"six unseen objects: {cell(pads[GP]['r2'], 2)}, best baseline {cell(baseline_on_pads, 2)}; "
            "[registered](docs/registration.md#object-and-camera-from-one-session) with known meshes "
            f"{cell(registered[GP]['r2'], 2)} "
            "([results](docs/results.md#simulated-objects-that-were-never-touched))",
            "errors of camera and arm cost half of what could be explained; "
            f"`{CALIBRATED}` was partly tuned on that skin",
        ],
        [
            "calibrate a skin from 20 presses, R²",
            f"one eFlesh skin, blocks held out: {cell(press, 2)}, plain GP {cell(plain, 2)} "
            "([calibration](docs/calibration.md))",
            "better than a plain GP ([calibration](docs/calibration.md))",
            "partly tuned on that skin; the layer's physics failed on it",
        ],
    ]


def _objects(results: Mapping[str, Measured]) -> list[list[str]]:
    paper, belief = results["paper"]["mean of the sets"], results["recognize"]["sets"]["all"]["methods"]
    votes = ", ".join(f"{name} {cell(paper[method]['mean'], 2)}" for name, method in VOTES.items())
    fused, readings_alone = (at(belief[evidence]["accuracy"], -1) for evidence in ("fused", "readings"))
    _, _, others = cell(belief["fused"]["last_other_objects"], 2).partition(" ")
    rows = results["physics"]["tables"]["methods"]["rows"]
    means = {tuple(row[:3]): cell(row[3]["mean"], 2) for row in rows}
    readings, readings_own, belief_none, belief_own = (
        " / ".join(
            means[name, evidence, touches]
            for name in ("free side faces", "soft compressible layer", "Winkler foundation")
        )
        for evidence in ("readings", "fused")
        for touches in ("none", "200")
    )
    matched, both = (means["bonded layer", evidence, "all"] for evidence in ("readings", "fused"))
    return [
        [
            "the paper's recognition, mean of its five objects, chance .40",
            "not yet",
            f"{votes}; the paper's real skin .58, proprioception .46 ([recognition](docs/recognition.md))",
            "masks do worse than proprioception on tools; depths, which the paper describes, are not shown to beat "
            "proprioception by votes",
        ],
        [
            "recognition by the belief, ten touches, chance .20",
            "not yet",
            f"{cell(fused, 2)} on six pads; interval for similar objects {others}; from readings alone "
            f"{cell(readings_alone['mean'], 2)} ([recognition](docs/recognition.md))",
            f"skins with free sides / a soft layer / springs, mean over all touches: readings alone {readings} "
            f"instead of {matched} without touches of that skin, {readings_own} with 200; fused {belief_none} instead "
            f"of {both} without, "
            f"{belief_own} with 200",
        ],
    ]


def _others(results: Mapping[str, Measured]) -> list[list[str]]:
    heads = results["fidelity"]["recordings"]["20250316_155729_probe"]["Heads"]["heads"]
    rebuilt = results["reconstruct_baselines"]
    read, posed = _with_and_without_readings(rebuilt)
    fitted_read, fitted_posed = _with_and_without_readings(results["reconstruct_fitted"])
    tip = heads["position"]["whole blocks or strokes"]["kept"]["median"]
    later = results["strokes"]["splits"]["in file order"]["methods"]
    warped, at_rest = later["time-warped strokes"], later["control: samples at rest, median subtracted"]
    best, with_ambient = (
        max((scores for name, scores in later.items() if name.endswith(kind)), key=lambda scores: scores["accuracy"][0])
        for kind in ("ambient subtracted", "raw readings")
    )
    stamps = {name: cell(scores["total"][0], 2) for name, scores in results["shapes"]["splits"]["random"].items()}
    of_paper, with_pose = stamps["paper's classifier"], stamps["classifier with pose"]
    return [
        [
            "recognise shapes",
            f"digits drawn on one skin, later strokes, chance .10: {cell(warped['accuracy'], 2)}, best baseline "
            f"{cell(best['accuracy'], 2)}, lead {cell(best[LEAD], 2)} "
            "([shapes](docs/shapes.md#on-a-real-skin))",
            f"stamps: predicted touch {stamps['predicted touch']}, paper's classifier {of_paper}, a tuned one with "
            f"pose and force {with_pose}",
            "each digit is one recording, so the ambient field identifies it: without subtracting that field, the best "
            f"baseline reaches {cell(with_ambient['accuracy'][0], 2)}; samples at rest alone, with the median "
            f"subtracted, reach {cell(at_rest['accuracy'][0], 2)}",
        ],
        [
            "patches from depth images",
            "frames of YCB-Video and APC ([depth](docs/depth.md))",
            "against the mesh ([depth](docs/depth.md))",
            "sharp ridges appear too deep",
        ],
        [
            "touch to shape",
            f"position of a tip, not a shape: median error {cell(tip, 1)} mm ([heads](docs/fidelity.md#heads))",
            f"{rebuilt['test_objects']} unseen objects: {cell(read['ratio'], 2)} of the distance left after 5 touches "
            f"({cell(read['chamfer_mm'][0], 1)} mm), without readings {cell(posed['ratio'], 2)} "
            f"({cell(posed['chamfer_mm'][0], 1)} mm) "
            "([reconstruction](docs/reconstruction.md))",
            f"pad fitted from 300 presses, pose known to 3 mm and 5 degrees: {cell(fitted_read['ratio'][0], 2)}, "
            f"without readings {cell(fitted_posed['ratio'][0], 2)}; needs a library of similar objects",
        ],
        [
            "drivers: ReSkin, UR arm, RealSense",
            "**not yet**",
            "emulators of the devices' protocols ([hardware](docs/hardware.md))",
            "no real device has been tried",
        ],
    ]


def _with_and_without_readings(measured: Measured) -> tuple[Measured, Measured]:
    """Select the scores after 5 touches with readings, and those of the better condition without them."""
    scores = {name: condition["after"]["5"] for name, condition in measured["conditions"].items()}
    with_readings = scores.pop(next(name for name in scores if name.startswith("reading")))
    return with_readings, min(scores.values(), key=lambda entry: entry["ratio"][0])
