"""Question: how well does one press of a skin with five chips determine the surface below it, and is the stated
uncertainty calibrated?

    python -m experiments.reconstruct patch                      160 contacts of unknown objects, 3 pads
    python -m experiments.reconstruct patch --preset short       a third of that
    python -m experiments.reconstruct patch --preset debug       too few presses for a result
    python -m experiments.reconstruct patch --exact              presses without error: the limits of the pad itself

Catalogue objects and random objects, from stamp to hand size, are split by object into a library, validation objects
(all choices) and test objects. Each is approached at random safe sites with a tilt of 1 to 6 degrees and pressed by the
full physics, to 25 uT and on to 100 uT or 8 N, with friction, a slant of one degree, and the noise of real sensors (no
drift). Methods: Bayesian inference with predicted readings (`i2t.reconstruction`) at the first stop and at both stops,
with the pad's true physics; at both stops with a pad fitted to 300 presses of a ball; and the prior as a baseline.
Everything is simulated.

Time: about five minutes on one core. Expect the press curve to beat the first stop, and the first stop to beat the
prior.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from experiments.common.runs import begin, write_json
from experiments.reconstruct.arguments import PATCH_PRESETS, PatchArgs
from experiments.reconstruct.patch_scores import LEVELS, choose_thresholds, report_of, score_table, score_touch
from experiments.reconstruct.patch_world import MetSurface, Trial, list_names, make_parts, press_parts
from i2t import viz
from i2t.intervals import rows_of
from i2t.patches.dimensions import CONTACT_TOLERANCE_M, PATCH_WINDOW, REACH
from i2t.reconstruction.local_shape import PatchLibrary, PatchLikelihood, PressModel, infer_patch
from i2t.rendering.ops import element
from i2t.simulation.press_curves import PressCurve
from i2t.simulation.touches import SimulationErrors
from i2t.skin.contact import CELL_GRID
from i2t.types import Array
from i2t.viz import style

PRIOR, FIRST_STOP, CURVE = "prior", "one stop at 25 uT", "press curve"
FITTED = f"{CURVE}, fitted pad"
COLUMNS = {
    "mask_iou": "mask IoU", "mask_skill": "skill", "contact_iou": "contact IoU", "centre_mm_median": "centre mm",
    "centre_mm_90": "at 90 %", "edge_degrees_median": "edge, deg", "edge_mm_median": "edge, mm",
    "crps_mm": "CRPS mm", "crps_ratio": "CRPS / prior's", "coverage_90": "cover 90 %",
}  # fmt: skip
Scores = dict[str, np.ndarray]
Infer = Callable[[PressCurve, PressModel, PatchLibrary], Array]  # posterior weights of the library's patches


def run(args: PatchArgs) -> dict[str, Any]:
    """Run all methods on the same presses; print the table, write metrics.json, config.json and a figure."""
    sizes = PATCH_PRESETS[args.preset]
    begin(args, sizes)
    key_parts, key_presses, _ = jax.random.split(jax.random.key(args.seed), 3)  # three keys, as in the published runs
    parts = make_parts(key_parts, sizes)
    library = jax.tree.map(jnp.asarray, parts["train"].library)
    errors = SimulationErrors.error_free() if args.exact else SimulationErrors()
    trials = press_parts(key_presses, parts, library, sizes, errors)
    likelihood = choose_likelihood(trials["validation"], library)
    trials = {name: [trial.with_likelihood(likelihood) for trial in some] for name, some in trials.items()}
    chosen: dict[str, Any] = {"likelihood": {name: float(value) for name, value in likelihood._asdict().items()}}
    scores_by_method: dict[str, Scores] = {}
    for name, infer in METHODS.items():
        used = {part: [trial.with_fitted_pad() if name == FITTED else trial for trial in some]
                 for part, some in trials.items()}  # fmt: skip
        chosen[name] = choose_thresholds(score_touches(infer, used["validation"], library))
        scores_by_method[name] = score_touches(infer, used["test"], library)
    objects = parts["test"].library.object
    clusters = [np.tile(objects, sizes.pads), np.repeat(np.arange(sizes.pads), len(objects))]

    def reported(rows: np.ndarray) -> dict[str, Any]:
        """Scores of all methods at some of the touches."""
        some = {
            name: {score: values[rows] for score, values in scores.items()} for name, scores in scores_by_method.items()
        }
        labels = rows_of(clusters, rows)
        return {
            "touches": int(rows.sum()),
            "objects": len(np.unique(labels[0])),
            "methods": {
                name: report_of(scores, some[PRIOR], chosen[name], chosen[PRIOR], labels)
                for name, scores in some.items()
            },
        }

    listed = clusters[0] < len(list_names("test"))
    report: dict[str, Any] = {
        "source": "simulated",
        "counts": {name: len(part.library.patch) for name, part in parts.items()},
        "objects": {name: len(np.unique(part.library.object)) for name, part in parts.items()},
        "pads": sizes.pads,
        "seed": args.seed,
        "exact": args.exact,
        "edges": int(np.isfinite(scores_by_method[PRIOR]["edge"][:, 0]).sum()),
        "chosen": chosen,
        "touches": len(clusters[0]),
        "methods": reported(np.ones_like(listed))["methods"],
        "sources": {
            name: reported(rows) for name, rows in (("catalogue", listed), ("random shapes", ~listed)) if rows.any()
        },
    }
    write_json(args.out / "metrics.json", report)
    viz.save_figure(draw_posteriors(trials["test"][0], library), args.out / "posteriors.png")
    print(score_table("simulated", COLUMNS, report["methods"]))
    for name, part in report["sources"].items():
        print("\n" + score_table(name, COLUMNS, part["methods"]))
    return report


def choose_likelihood(trials: Sequence[Trial], library: PatchLibrary) -> PatchLikelihood:
    """Choose the likelihood's constants on validation objects.

    Of the options whose CRPS (at one stop and at both) is within 1.5 % of the smallest, the one whose 90 % intervals
    have the coverage closest to 90 % is chosen: sharpness subject to calibration (Gneiting et al., JRSS B 69, 2007).
    The blur is that of the best masks.
    """

    def scored(likelihood: PatchLikelihood) -> Scores:
        some = [trial.with_likelihood(likelihood) for trial in trials]
        parts = [score_touches(infer, some, library) for infer in (_bayes_first, _bayes)]
        return {name: np.concatenate([part[name] for part in parts]) for name in ("crps_mm", "covered", "mask")}

    def best(options: list[PatchLikelihood]) -> PatchLikelihood:
        scores = [scored(option) for option in options]
        crps = np.array([np.mean(option["crps_mm"]) for option in scores])
        miscoverage = np.array([abs(np.nanmean(option["covered"][:, -1]) - LEVELS[-1]) for option in scores])
        return options[int(np.argmin(np.where(crps <= 1.015 * crps.min(), miscoverage, np.inf)))]

    start = PatchLikelihood()
    start = best(
        [start._replace(relative_error=e, temperature=t) for e in (0.05, 0.1, 0.15) for t in (1.0, 1.5, 2.0, 3.0)]
    )
    start = best([start._replace(dof=dof) for dof in (3.0, 6.0, 30.0)])
    masks = {blur: scored(start._replace(blur=blur))["mask"].mean(0).max() for blur in (0.0, 1.0, 2.0, 3.0)}
    return start._replace(blur=max(masks, key=lambda blur: masks[blur]))


def _alike(press: PressCurve, model: PressModel, library: PatchLibrary) -> Array:
    """Equal weights, independent of the reading."""
    return jnp.full(len(library.patch), 1 / len(library.patch))


def _bayes(press: PressCurve, model: PressModel, library: PatchLibrary) -> Array:
    return infer_patch(press.reading, press.force, press.travel, model=model, library=library, samples=1).weight


def _bayes_first(press: PressCurve, model: PressModel, library: PatchLibrary) -> Array:
    """Posterior weights from the first stop alone."""
    return _bayes(jax.tree.map(lambda field: field[:1], press), model, library)


METHODS: dict[str, Infer] = {PRIOR: _alike, FIRST_STOP: _bayes_first, CURVE: _bayes, FITTED: _bayes}


def score_touches(infer: Infer, trials: Sequence[Trial], library: PatchLibrary) -> Scores:
    """Score a method at the touches of all pads, concatenated pad by pad."""
    parts = []
    for trial in trials:
        presses, truth = jax.tree.map(jnp.asarray, (trial.presses, trial.truth))
        weights = _infer_all(infer)(presses, trial.model, library)
        blur = jnp.float32(0.0 if infer is _alike else trial.model.likelihood.blur)  # of masks, in pixels
        score = _score_all(weights, presses.force[:, -1], truth, library=library, blur=blur)
        parts.append(jax.device_get(score))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


@cache
def _infer_all(infer: Infer) -> Callable[..., Array]:
    """Compile a method's inference over all presses of one pad."""
    return jax.jit(lambda presses, model, library: jax.lax.map(lambda press: infer(press, model, library), presses))


@jax.jit
def _score_all(
    weights: Array, force: Array, truth: MetSurface, *, library: PatchLibrary, blur: Array
) -> dict[str, Array]:
    return jax.lax.map(partial(score_touch, library=library, blur=blur), (weights, force, truth))


def draw_posteriors(trial: Trial, library: PatchLibrary, presses: int = 5) -> Figure:
    """Draw readings, true patch, posterior mean, two samples and the mask's probability of a few presses."""
    titles = ("readings (uT)", "true patch", "mean", "sample 1", "sample 2", "mask probability")
    count = min(presses, len(trial.truth.patch))
    infer = jax.jit(partial(infer_patch, model=trial.model, library=library))
    figure = Figure(figsize=(11.5, 1.85 * count + 0.9), layout="constrained")
    axes = figure.subplots(count, len(titles), squeeze=False)
    for number, row in enumerate(axes):
        press, patch = element(trial.presses, number), trial.truth.patch[number]
        posterior = jax.device_get(infer(press.reading, press.force, press.travel))
        for stop, colour in zip(press.reading, (style.Colour.BLUE, style.Colour.ORANGE), strict=False):
            row[0].plot(np.arange(len(stop)), stop, color=colour, lw=1, marker=".", ms=4)
        row[0].set_xticks([])
        row[0].tick_params(labelsize=7)
        samples = posterior.patch[[len(posterior.patch) // 3, 2 * len(posterior.patch) // 3]]
        for axis, depth in zip(row[1:5], (patch, posterior.mean, *samples), strict=True):
            image = viz.draw_patch(axis, np.asarray(depth, np.float32), PATCH_WINDOW, REACH)
        extent = image.get_extent()
        mask = row[5].imshow(posterior.mask_probability, origin="lower", extent=extent, cmap="Greys", vmin=0, vmax=1)
        at, met = np.linspace(extent[0], extent[1], len(patch)), patch <= CONTACT_TOLERANCE_M
        if met.any() and not met.all():
            row[5].contour(at, at, patch, levels=[CONTACT_TOLERANCE_M], colors=style.Colour.RED, linewidths=1)
        pressed = trial.truth.contact[number].reshape(CELL_GRID.cells, -1)
        row[1].contour(
            1e3 * CELL_GRID.centres, 1e3 * CELL_GRID.centres, pressed, [0.5], colors=style.Colour.RED, linewidths=1
        )
        row[1].set(xlim=extent[:2], ylim=extent[2:])
        for axis in row[1:]:
            axis.set(xticks=[], yticks=[], xlabel="", ylabel="")
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=10)
    figure.colorbar(image, ax=axes[:, 1:5], label="depth beyond first contact (mm)", location="bottom", aspect=60)
    figure.colorbar(mask, ax=axes[:, 5], label="line: true outline", location="bottom", aspect=14)
    figure.suptitle("Surface inferred from one press: 17 x 17 mm, unknown objects (simulated); red: contact of the pad")
    return figure
