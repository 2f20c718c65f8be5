"""Question: what does one press of a skin with five chips say of the surface that it met, and is its doubt honest?

    python -m experiments.reconstruct_patch                      12 000 patches, 160 contacts of unseen objects, 3 pads
    python -m experiments.reconstruct_patch --preset short       a third of that
    python -m experiments.reconstruct_patch --meshes FOLDER      the meshes (OBJ, PLY, STL; metres) of a folder
    python -m experiments.reconstruct_patch --preset debug       too few to mean anything
    python -m experiments.reconstruct_patch --dataset DATA       where the tip of recorded presses was (`recorded.py`)

Objects of the catalogue and drawn ones, from a stamp's size to a hand's, are split by object into those of the library,
those on which everything is chosen (validation) and those that are judged (test). Each is met at random safe sites, the
approach tilted by 1 to 6 degrees, and pressed by the full physics: to 25 uT and on to 100 uT or 8 N, with friction, a
slant of a degree, and the noise of real sensors (no drift). Methods: Bayes by imagination at the first stop and at both
(`i2t.reconstruction`), the same with a forward model learned from the pad's touches, nearest neighbours on readings, a
network from readings to pixels; to compare, the prior and a perfect tactile image of 1 mm. All of it is simulated.

About ten minutes on one core. Expect the press curve to beat the first stop, and both to beat neighbours and network.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from experiments.common.runs import begin, write_json
from experiments.reconstruct_patch import methods, recorded, scores
from experiments.reconstruct_patch.arguments import PatchArgs
from experiments.reconstruct_patch.figures import draw_posteriors, draw_reliability
from experiments.reconstruct_patch.trials import (
    Scores,
    ShapeMethod,
    Trial,
    by_imagination,
    by_neighbours,
    by_network,
    by_prior,
    by_tactile_image,
    score_touches,
)
from experiments.reconstruct_patch.world import Part, make_parts, press_all, truth_of
from i2t import viz
from i2t.progress import progress
from i2t.recognition.intervals import cluster_interval
from i2t.reconstruction.local_shape import (
    CONTACT_CLASSES,
    PatchLibrary,
    PatchLikelihood,
    infer_patch,
)
from i2t.reconstruction.press_models import imagine_presses
from i2t.rendering.ops import element
from i2t.skin.pad import numbered_pad
from i2t.types import Array

PRIOR, LEARNED = "prior", "by imagination, learned forward model, press curve"
BAYES = ("by imagination, 25 uT", "by imagination, press curve")
IMAGES = ("perfect tactile image, 25 uT", "perfect tactile image, press curve")
NEIGHBOURS, NETWORK = "nearest neighbours, press curve", "network, press curve"
RELATIVE_ERRORS, TEMPERINGS = (0.04, 0.08, 0.15), (0.25, 0.5, 1.0)  # what is chosen among
DOFS, BLURS = (3.0, 8.0, 30.0), (0.0, 1.0, 2.0)
NEIGHBOURS_TRIED, IMAGE_WIDTHS = (8, 24, 72), (0.1, 0.2, 0.3, 0.5)


def run(args: PatchArgs) -> dict[str, Any]:
    """Run every method on the same presses; print the table, write metrics.json, config.json and figures."""
    if args.dataset is not None:
        return recorded.run(args)
    sizes = args.sizes
    begin(args.out, args, sizes, None, args.overwrite)
    key_parts, key_presses, key_methods = jax.random.split(jax.random.key(args.seed), 3)
    parts = make_parts(key_parts, args)
    library = jax.tree.map(jnp.asarray, parts["train"].library)
    trials = press_parts(key_presses, parts, library, sizes.pads)
    chosen = choose_likelihood(trials["validation"], library)
    trials = {name: [trial.with_likelihood(chosen) for trial in some] for name, some in trials.items()}
    found, picked = {}, {"likelihood": {name: float(value) for name, value in chosen._asdict().items()}}
    for name, options in list_methods(key_methods, trials["test"], library, sizes.steps).items():
        found[name], picked[name] = try_method(name, options, trials, library)
    report: dict[str, Any] = {
        "source": "simulated",
        "counts": {name: len(part.library.patch) for name, part in parts.items()},
        "objects": {name: len(np.unique(part.library.object)) for name, part in parts.items()},
        "pads": sizes.pads,
        "seed": args.seed,
        "chosen": picked,
    } | evaluate(found, picked, trials["test"], parts["test"])
    report["candidates"] = judge_candidates(trials["test"], parts["test"])
    write_json(args.out / "metrics.json", report)
    viz.save_figure(_drawn(trials["test"][0], library), args.out / "posteriors.png")
    shown = (BAYES[0], BAYES[1], NEIGHBOURS, NETWORK)
    viz.save_figure(draw_reliability(report["methods"], shown), args.out / "reliability.png")
    print(table(report))
    return report


def press_parts(key: Array, parts: dict[str, Part], library: PatchLibrary, pads: int) -> dict[str, list[Trial]]:
    """Every contact of validation and test, pressed with every pad; and every pad imagined at the library."""
    trials: dict[str, list[Trial]] = {"validation": [], "test": []}
    for number in progress(range(pads), desc="pads"):
        pad = numbered_pad(number)
        model = imagine_presses(pad, library)
        for which, (name, some) in enumerate(trials.items()):
            heights = jnp.asarray(parts[name].heights)
            own = jax.random.split(jax.random.fold_in(key, 2 * number + which), len(heights))
            presses = jax.device_get(press_all(own, pad, heights))
            some.append(Trial(pad, model, presses, truth_of(parts[name], presses)))
    return trials


def choose_likelihood(trials: Sequence[Trial], library: PatchLibrary) -> PatchLikelihood:
    """The likelihood by which press curves of validation objects have the least CRPS, and their masks the best IoU."""

    def scored(likelihood: PatchLikelihood) -> Scores:
        models = [trial.with_likelihood(likelihood).model for trial in trials]
        return score_touches(by_imagination(models), trials, library)

    def best(options: list[PatchLikelihood]) -> PatchLikelihood:
        return min(options, key=lambda each: float(np.mean(scored(each)["crps_mm"])))

    start = PatchLikelihood()
    start = best([start._replace(relative_error=e, temperature=t) for e in RELATIVE_ERRORS for t in TEMPERINGS])
    start = best([start._replace(dof=dof) for dof in DOFS])
    masks = {blur: scored(start._replace(blur=blur))["mask"].mean(0).max() for blur in BLURS}
    return start._replace(blur=max(masks, key=lambda blur: masks[blur]))


def list_methods(
    key: Array, trials: Sequence[Trial], library: PatchLibrary, steps: int
) -> dict[str, dict[str, ShapeMethod]]:
    """Every method, as one or several options of which validation objects choose."""
    models = [trial.model for trial in trials]
    key_learned, key_presses, key_network = jax.random.split(key, 3)
    learned, seen, networks = [], [], []
    rows = np.arange(len(library.patch))
    for number, trial in enumerate(trials):
        own = (jax.random.fold_in(each, number) for each in (key_learned, key_presses, key_network))
        key_gp, key_imagined, key_layers = own
        learned.append(methods.learned_model(key_gp, trial.model, library, trial.pad.board))
        presses = methods.imagined_presses(key_imagined, trial.model, rows)
        inputs = jax.vmap(methods.features)(presses)
        seen.append((inputs, jnp.std(inputs, axis=0) + 1e-6))
        networks.append(methods.train_network(key_layers, presses, library, steps))
    return {
        PRIOR: {"": by_prior(models)},
        BAYES[0]: {"": by_imagination(models, first_stop_only=True)},
        BAYES[1]: {"": by_imagination(models)},
        LEARNED: {"": by_imagination(learned)},
        NEIGHBOURS: {str(k): by_neighbours(seen, k) for k in NEIGHBOURS_TRIED},
        NETWORK: {"": by_network(networks)},
        IMAGES[0]: {str(w): by_tactile_image(len(models), w, first_stop_only=True) for w in IMAGE_WIDTHS},
        IMAGES[1]: {str(w): by_tactile_image(len(models), w) for w in IMAGE_WIDTHS},
    }


def try_method(
    name: str, options: dict[str, ShapeMethod], trials: dict[str, list[Trial]], library: PatchLibrary
) -> tuple[Scores, dict[str, Any]]:
    """Scores on test objects of the option that validation objects choose, and what they chose."""
    judged = {
        option: score_touches(method, trials["validation"], library)
        for option, method in progress(options.items(), desc=name)
    }
    best = min(judged, key=lambda option: float(np.mean(judged[option]["crps_mm"])))
    found = score_touches(options[best], trials["test"], library)
    return found, {"option": best, **scores.choose_thresholds(judged[best])}


def evaluate(found: dict[str, Scores], picked: dict[str, Any], trials: Sequence[Trial], part: Part) -> dict[str, Any]:
    """Every method's scores, over all touches and over those of the catalogue's objects alone."""
    truth = jax.tree.map(lambda *fields: np.concatenate(fields), *(trial.truth for trial in trials))
    clusters = _clusters(trials, part)
    named = np.tile(part.named, len(trials))
    results: dict[str, Any] = {"touches": len(named), "straight_edges": int(np.sum(truth.kind == 1))}
    for title, rows in (("methods", np.ones(len(named), bool)), ("catalogue", named)):
        if rows.any():
            some = [label[rows] for label in clusters]
            prior = {field: values[rows] for field, values in found[PRIOR].items()}
            results[title] = {
                name: scores.report(
                    {field: values[rows] for field, values in all_of.items()},
                    prior,
                    jax.tree.map(lambda field, rows=rows: field[rows], truth),
                    chosen=picked[name],
                    clusters=some,
                )
                for name, all_of in found.items()
            }
    return results


def judge_candidates(trials: Sequence[Trial], part: Part) -> dict[str, Any]:
    """Rates at which the patch that was met comes first, or among the first five, of 100 unseen ones, and the bits that
    a press tells of it.
    """
    judge = jax.jit(
        lambda presses, true, others, own, model: jax.lax.map(
            lambda each: methods.judge_candidate(each[0], each[1], each[2], own, model), (presses, true, others)
        )
    )
    candidates = jax.tree.map(jnp.asarray, part.library)
    count = len(candidates.patch)
    rng = np.random.default_rng(0)
    true = np.arange(count)
    others = np.stack([rng.permutation(np.delete(true, i))[: methods.RIVALS - 1] for i in true])
    results = {}
    for name, stops in ((BAYES[0], methods.first_stop), (BAYES[1], lambda presses: presses)):
        parts = []
        for trial in trials:
            own = imagine_presses(trial.pad, candidates, likelihood=trial.model.likelihood)
            presses = jax.tree.map(jnp.asarray, stops(trial.presses))
            parts.append(jax.device_get(judge(presses, jnp.asarray(true), jnp.asarray(others), own, trial.model)))
        rank, bits = (np.concatenate(column) for column in zip(*parts, strict=True))
        clusters = _clusters(trials, part)
        results[name] = {
            "recall_1": scores.numbers(cluster_interval(rank < 1, clusters)),
            "recall_5": scores.numbers(cluster_interval(rank < 5, clusters)),
            "bits": scores.numbers(cluster_interval(bits, clusters)),
            "candidates": min(methods.RIVALS, count),
        }
    return results


def _drawn(trial: Trial, library: PatchLibrary) -> Figure:
    """Posteriors of a few test touches, the first of each kind of contact and some more."""
    first = [np.flatnonzero(trial.truth.kind == kind)[:2] for kind in range(len(CONTACT_CLASSES))]
    rows = np.concatenate(first)
    infer = jax.jit(infer_patch, static_argnames=("samples",))
    found = [
        jax.device_get(infer(press.reading, press.force, press.travel, model=trial.model, library=library))
        for press in (element(trial.presses, row) for row in rows)
    ]
    return draw_posteriors([element(trial.presses, row) for row in rows], found, trial.truth.patch[rows])


def table(report: dict[str, Any]) -> str:
    """All methods' main numbers as text."""
    columns = {
        "mask_iou": "mask IoU", "contact_iou": "contact IoU",
        "centre_mm_median": "centre mm", "centre_mm_90": "at 90 %",
        "direction_deg_median": "edge deg", "position_mm_median": "edge mm", "crps_ratio": "CRPS / prior's",
        "coverage_90": "cover 90 %",
    }  # fmt: skip
    width = max(map(len, report["methods"]))
    lines = [f"{'simulated':{width}}  " + "  ".join(f"{title:>14}" for title in columns.values())]
    for name, found in report["methods"].items():
        cells = [f"{found[column][0]:14.3f}" if column in found else f"{'-':>14}" for column in columns]
        lines.append(f"{name:{width}}  " + "  ".join(cells))
    for name, found in report["candidates"].items():
        lines.append(
            f"{name}: of {found['candidates']} candidates first {found['recall_1'][0]:.2f}, in the first five "
            f"{found['recall_5'][0]:.2f}; {found['bits'][0]:.1f} bits"
        )
    return "\n".join(lines)


def _clusters(trials: Sequence[Trial], part: Part) -> list[np.ndarray]:
    """Labels of objects and of pads."""
    return [np.tile(part.library.object, len(trials)), np.repeat(np.arange(len(trials)), len(part.library.object))]
