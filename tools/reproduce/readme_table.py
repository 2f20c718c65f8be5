"""Tables over all steps: the small one of the README, and the longer one at the top of docs/results.md."""

import re
from collections.abc import Mapping

from experiments.common.cells import Measured, at
from experiments.common.tables import cell, markdown
from tools.reproduce.shape_tables import LEAD
from tools.reproduce.skin_tables import r2_of

GP = "Gaussian process on predicted contact pressure"
CALIBRATED = "i2t.calibrate"
NOT_DONE = "not done"
VOTES = {
    "masks": "Imagine2touch (paper's network, mask), votes",
    "depths": "Imagine2touch (paper's network, depth), votes",
    "proprioception": "proprioception, votes",
}


def overview(results: Mapping[str, Measured]) -> str:
    """Table of the README: a number in a cell, with its baseline, from real devices or recordings and simulation."""
    real, baseline = _real_presses(results)
    bonded = results["calibrate_simulated"]["cases"]["bonded, travel"]["r2"][CALIBRATED]["100"]
    study = results["study"]
    pads = study["over_pads"]
    simulated_baseline = max((pads[name]["r2"] for name in study["baselines"]), key=lambda r2: r2[0])
    fused = at(results["recognize"]["sets"]["all"]["methods"]["fused"]["accuracy"], -1)
    read, posed = _with_and_without_readings(results["reconstruct_baselines"])
    rows = [
        [
            "held-out presses of one skin, R²",
            f"one eFlesh skin, 1000 presses: {r2_of(2, real)}; best baseline {cell(baseline['r2'], 2)}",
            f"bonded skins, 100 presses: {cell(bonded, 2)}",
        ],
        [
            "touches of objects not trained on, R²",
            NOT_DONE,
            f"six objects: {cell(pads[GP]['r2'], 2)}; best baseline {cell(simulated_baseline[0], 2)}",
        ],
        ["one of five objects recognised (chance .20)", NOT_DONE, f"ten touches: {cell(fused, 2)}"],
        [
            "an unknown shape, share of the error left (less is better)",
            NOT_DONE,
            f"five touches: {cell(read['ratio'], 2)}; without readings {cell(posed['ratio'][0], 2)}",
        ],
        ["ReSkin board, UR arm, RealSense camera", NOT_DONE, "emulators of their protocols"],
    ]
    return _short(markdown(["question", "real devices or recordings", "simulated"], rows))


def summary(results: Mapping[str, Measured]) -> str:
    """Table with a row for each function of i2t and links to the sources of its numbers; `results` is by step."""
    rows = [*_skins(results), *_objects(results), *_others(results)]
    return _short(markdown(["task", "real data", "simulated", "limits"], rows))


def _short(table: str) -> str:
    """Write .94 in place of 0.94."""
    return re.sub(r"\b0(?=\.\d\d\b)", "", table)


def _real_presses(results: Mapping[str, Measured]) -> tuple[Measured, Measured]:
    """Scores of `i2t.calibrate` and of the best baseline on held-out blocks of a real skin."""
    blocks = results["train_blocks"]
    methods = blocks["methods"]
    by_position = next(scores for name, scores in methods.items() if name.startswith(CALIBRATED))
    baselines = (methods[name] for name in (*blocks["baselines"], "tuned GP on position and load"))
    return by_position, max(baselines, key=lambda scores: scores["r2"])


def _skins(results: Mapping[str, Measured]) -> list[list[str]]:
    study, calibrate = results["study"], results["calibrate"]
    by_position, baseline = _real_presses(results)
    from_image = results["train_blocks"]["methods"][GP]
    pads, registered = study["over_pads"], results["train_registered"]["over_pads"]
    baseline_on_pads = max((pads[name]["r2"] for name in study["baselines"]), key=lambda r2: r2[0])
    press = calibrate["calibrate_over_blocks"]["blocks of 6 mm"]["r2"]["20"]
    plain = calibrate["r2"]["blocks of 6 mm"]["plain Gaussian process"]["20"]["mean"]
    return [
        [
            "predict readings, R²",
            f"one eFlesh skin and tip, blocks held out: `{CALIBRATED}`, given the tip's position, "
            f"{r2_of(2, by_position)}; from an image {r2_of(2, from_image)}; best baseline {r2_of(2, baseline)}",
            f"six unseen objects: {cell(pads[GP]['r2'], 2)}, best baseline {cell(baseline_on_pads, 2)}; "
            f"[registered](#the-same-objects-registered) {cell(registered[GP]['r2'], 2)}",
            f"errors of camera and arm cost half; `{CALIBRATED}` was partly tuned on that skin",
        ],
        [
            "[calibrate](calibration.md) a skin from 20 presses, R²",
            f"one eFlesh skin, blocks held out: {cell(press, 2)}, plain GP {cell(plain, 2)}",
            "better than a plain GP",
            "partly tuned on that skin",
        ],
    ]


def _objects(results: Mapping[str, Measured]) -> list[list[str]]:
    paper, belief = results["paper"]["mean of the sets"], results["recognize"]["sets"]["all"]["methods"]
    votes = ", ".join(f"{name} {cell(paper[method]['mean'], 2)}" for name, method in VOTES.items())
    fused, readings_alone = (at(belief[evidence]["accuracy"], -1) for evidence in ("fused", "readings"))
    _, _, others = cell(belief["fused"]["last_other_objects"], 2).partition(" ")
    return [
        [
            "the paper's [recognition](recognition.md), mean of its five objects, chance .40",
            NOT_DONE,
            f"{votes}; the paper's real skin .58, proprioception .46",
            "masks lose to proprioception on tools; depths are not shown to beat it on the mean",
        ],
        [
            "recognition by the belief, ten touches, chance .20",
            NOT_DONE,
            f"{cell(fused, 2)}; interval for similar objects {others}; from readings alone "
            f"{cell(readings_alone['mean'], 2)}",
            "less on [skins of other physics](recognition.md#a-skin-of-other-physics)",
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
            "recognise [shapes](shapes.md)",
            f"digits drawn on one skin, later strokes, chance .10: {cell(warped['accuracy'], 2)}, best baseline "
            f"{cell(best['accuracy'], 2)}, lead {cell(best[LEAD], 2)}",
            f"stamps: predicted touch {stamps['predicted touch']}, paper's classifier {of_paper}, a tuned one with "
            f"pose and force {with_pose}",
            "each digit is one recording, which the ambient field identifies: with it, the best baseline reaches "
            f"{cell(with_ambient['accuracy'][0], 2)}; samples at rest, median subtracted, "
            f"{cell(at_rest['accuracy'][0], 2)}",
        ],
        [
            "touch to [shape](reconstruction.md)",
            f"position of a tip, not a shape: median error {cell(tip, 1)} mm ([heads](fidelity.md#heads))",
            f"{rebuilt['test_objects']} unseen objects: {cell(read['ratio'], 2)} of the distance left after 5 touches "
            f"({cell(read['chamfer_mm'][0], 1)} mm), without readings {cell(posed['ratio'], 2)} "
            f"({cell(posed['chamfer_mm'][0], 1)} mm)",
            f"pad fitted from 300 presses, pose known to 3 mm and 5 degrees: {cell(fitted_read['ratio'][0], 2)}, "
            f"without readings {cell(fitted_posed['ratio'][0], 2)}; needs a library of similar objects",
        ],
        [
            "[drivers](hardware.md): ReSkin, UR arm, RealSense",
            f"**{NOT_DONE}**",
            "emulators of the devices' protocols",
            "no real device has been tried",
        ],
    ]


def _with_and_without_readings(measured: Measured) -> tuple[Measured, Measured]:
    """Select the scores after 5 touches with readings, and those of the better condition without them."""
    scores = {name: condition["after"]["5"] for name, condition in measured["conditions"].items()}
    with_readings = scores.pop(next(name for name in scores if name.startswith("reading")))
    return with_readings, min(scores.values(), key=lambda entry: entry["ratio"][0])
