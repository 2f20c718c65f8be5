"""Question: do views and readings of the same touches have similar neighbourhoods, so that one may predict the other?

    python -m experiments.tsne                       1630 simulated touches, as many as in the paper
    python -m experiments.tsne --dataset DIR         recorded or converted touches
    python -m experiments.tsne --preset debug        a few touches, too few for meaningful results

The figure is the paper's: t-SNE of the contact masks or depth patches and their five-means clusters, with the mean
patch, the mean tactile picture and examples of each cluster. Numbers complete it: the stability of clusters and map
from seed to seed, and the agreement between the neighbourhoods and geometry of views and of readings, compared with
random pairings of all touches and of touches of the same object. The latter exclude agreement that is due to the object
alone. It takes half a minute on two cores; expect a weak agreement, p = 0.001. Results go to --out: tsne.png,
metrics.json, the touches (data.h5).
"""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.common.presets import choose_preset
from experiments.common.runs import begin, write_json
from experiments.train.configs import PRESETS as TRAININGS
from experiments.train.simulate import simulated_dataset
from experiments.tsne.arguments import TsneArgs
from i2t import dataset as data
from i2t import viz
from i2t.dataset import Dataset, holds_simulated, source_phrase
from i2t.errors import DataError
from i2t.recognition.metrics import to_json
from i2t.skin.pad import pad_from_seed
from i2t.types import ReturnCode
from i2t.viz import agreement, clusters
from i2t.viz.clusters import TouchMap


@dataclass(frozen=True)
class Plan:
    """Settings of `python -m experiments.tsne`."""

    seeds: int = 10  # number of seeds of the clusters
    maps: int = 3  # number of seeds of the map
    permutations: int = 999  # random pairings
    example_ranks: tuple[float, ...] = (0.0, 0.5)  # examples: least and median distance from the cluster's mean


PRESETS = {"paper": Plan(), "debug": Plan(3, 2, 99)}


def run(args: TsneArgs) -> dict[str, Any]:
    """Map and cluster the touches, test stability and agreement, and draw the figure."""
    plan = choose_preset(PRESETS, args.preset)
    begin(args, plan)
    dataset = read_touches(args)
    touches = dataset.touches
    started = time.perf_counter()
    pixels = clusters.views(touches.patch, args.kind)
    views = clusters.components(pixels)
    touch_map = clusters.map_touches(views, clusters.cluster(views, seed=args.seed), args.seed, plan.example_ranks)
    seconds = time.perf_counter() - started

    whole, parts = clusters.stability(views, seeds=plan.seeds)
    others = [clusters.embed(views, seed=args.seed + i)[0] for i in range(1, plan.maps)]
    kept = np.array([agreement.agreement(touch_map.at, other).overlap for other in others])
    result: dict[str, Any] = {
        "source": dataset.source,
        "seed": args.seed,
        "touches": len(dataset),
        "view": args.kind,
        "seconds": round(seconds, 1),
        "cluster_sizes": np.bincount(touch_map.label).tolist(),
        "rand_index": {"seeds": _mean_and_minimum(whole), "parts": _mean_and_minimum(parts)},
        "map_neighbours_kept": _mean_and_minimum(kept),
        "variance_kept": float(views.var(0).sum() / pixels.var(0).sum()),
        "agreement": tests(views, clusters.standardised(touches.reading), touches.object, plan, args.seed),
    }
    viz.save_figure(figure(dataset, touch_map, args.kind), args.out / "tsne.png")
    write_json(args.out / "metrics.json", result)
    report(result)
    return result


def read_touches(args: TsneArgs) -> Dataset:
    """Load recorded touches, or simulate them, and select those with contact (DataError: there are too few)."""
    if args.dataset:
        dataset = data.load_dataset(args.dataset)
    else:
        plan, name = TRAININGS[args.preset].simulation, "simulated pad 0"
        dataset = simulated_dataset(plan, pad_from_seed(0), args.out / "data.h5", seed=args.seed, name=name)
    dataset = dataset.select(~np.isin(dataset.touches.code, [ReturnCode.FAILED, ReturnCode.AIR]))
    least = 4 * agreement.NUM_NEIGHBOURS
    if len(dataset) < least:
        raise DataError(f"the data set holds {len(dataset)} touches; at least {least} are needed")
    return dataset


def tests(x: np.ndarray, y: np.ndarray, groups: np.ndarray, plan: Plan, seed: int) -> dict[str, Any]:
    """Test the agreement of two modalities against random pairings of all touches and within objects."""
    results = {"all": agreement.permutation_test(x, y, permutations=plan.permutations, seed=seed)}
    if len(np.unique(groups)) > 1:
        results["within objects"] = agreement.permutation_test(
            x, y, permutations=plan.permutations, seed=seed, groups=groups
        )
    return {name: to_json(test) for name, test in results.items()}


def figure(dataset: Dataset, touch_map: TouchMap, kind: str) -> Any:
    """Draw the map with its clusters, and the mean view, the mean reading and examples of each cluster."""
    touches = dataset.touches
    values = clusters.views(touches.patch, "mask" if kind == "mask" else "depth").reshape(touches.patch.shape)
    name = "contact mask" if kind == "mask" else "depth, relative to the reach"
    return viz.plot_clusters(
        touch_map,
        viz.TouchViews(values, dataset.window, name),
        np.asarray(touches.reading),
        [dataset.objects[i] for i in touches.object],
        dataset.board,
        title=f"{len(touch_map.at)} touches by similarity of their views",
        simulated=holds_simulated(dataset.source),
    )


def report(result: dict[str, Any]) -> None:
    """Print the numbers."""
    kind = "" if result["source"] == "real" else f" ({source_phrase(result['source'])})"
    index, kept = result["rand_index"], result["map_neighbours_kept"]
    print(f"\n{result['touches']} touches{kind}: map and clusters in {result['seconds']:.1f} s")
    print(f"clusters of {', '.join(map(str, result['cluster_sizes']))} touches")
    print(f"adjusted Rand index between seeds: mean {index['seeds'][0]:.2f}, minimum {index['seeds'][1]:.2f}")
    print(f"  between random 80 % of the touches: mean {index['parts'][0]:.2f}, minimum {index['parts'][1]:.2f}")
    print(f"share of nearest neighbours on the map with another seed: {kept[0]:.2f}")
    columns = {"overlap": "overlap", "mutual": "mutual", "cka": "CKA"}
    print(f"\n{'views and readings':52}" + "".join(f"{title:>12}{'chance':>8}{'p':>7}" for title in columns.values()))
    for pairing, test in result["agreement"].items():
        cells = "".join(f"{test['observed'][n]:12.3f}{test['chance'][n]:8.3f}{test['p'][n]:7.3f}" for n in columns)
        print(f"  random pairing: {pairing:34}{cells}")


def _mean_and_minimum(values: np.ndarray) -> list[float]:
    """Compute mean and minimum."""
    return [float(values.mean()), float(values.min())] if len(values) else [float("nan")] * 2
