"""One object explored under one condition, touch after touch."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.reconstruct.arguments import ExplorationCondition, ReconstructArgs, ReconstructSizes
from experiments.reconstruct.scores import SurfaceErrors, TrueShape, hidden_points, judge, surface_errors
from experiments.reconstruct.world import APPROACH_M, EXPLORING_OVERTRAVEL_M, Reality, Session, begin_session
from i2t.reconstruction.exploration import (
    AROUND_LIMITS,
    POLICY_NAMES,
    ExplorationConfig,
    PolicyName,
    choose_touch,
)
from i2t.reconstruction.signed_distances import interpolate
from i2t.reconstruction.surface import (
    SurfaceEstimate,
    SurfaceModel,
    SurfaceState,
    add_view,
    estimate_surface,
    init,
    update,
)
from i2t.simulation.site_limits import SiteLimits

REPORTED = (0, 1, 5, 10, 20)  # touches
ORACLE_POINTS = 500  # of the true surface, by which the oracle judges


@dataclass(frozen=True)
class Explorer:
    """Data that all episodes of a run share."""

    models: dict[bool, SurfaceModel]  # with the library, and of smoothness alone
    shapes: list[TrueShape]  # of the reality's objects
    reality: Reality
    sizes: ReconstructSizes
    seed: int
    limits: SiteLimits


@dataclass
class Episode:
    """One object, touched until the touches are used up."""

    scores: dict[int, dict[str, float]]  # after so many touches
    errors: dict[int, SurfaceErrors]  # at points of the true surface
    estimates: dict[int, SurfaceEstimate]
    state: SurfaceState
    stopped: bool  # because no site was safe


def site_limits(args: ReconstructArgs) -> SiteLimits:
    """Limits of safe sites, for an object that is held or one on a table."""
    return AROUND_LIMITS if args.reach == "around" else SiteLimits()


def reported(touches: int) -> tuple[int, ...]:
    """Numbers of touches after which surfaces are judged."""
    return tuple(sorted({count for count in REPORTED if count <= touches} | {touches}))


def explore(explorer: Explorer, number: int, condition: ExplorationCondition, *, seed: int) -> Episode:
    """Touch one object, whose errors of the lab depend on object and seed only: conditions share them."""
    model = explorer.models[condition.library]
    session = begin_session(explorer.reality, number, seed=1000 * explorer.seed + seed)
    state, _ = init(model)
    truth, hidden = explorer.shapes[number], None
    if condition.view:
        points, origin = session.view()
        state, _ = add_view(model, state, points, origin)
        hidden = hidden_points(truth, points)
    oracle = condition.policy == "oracle"
    touches = min(explorer.sizes.touches, explorer.sizes.oracle_touches) if oracle else explorer.sizes.touches
    policy: PolicyName = next(
        (name for name in POLICY_NAMES if name == condition.policy), "random"
    )  # the oracle chooses by itself
    config = ExplorationConfig(policy, limits=explorer.limits, approach=APPROACH_M, overtravel=EXPLORING_OVERTRAVEL_M)
    episode = Episode({}, {}, {}, state, False)
    for done in range(touches + 1):
        if done in reported(touches):
            _report(episode, model, done, truth=truth, hidden=hidden)
        if done == touches:
            break
        step = int(np.random.SeedSequence([explorer.seed, seed, number, done]).generate_state(1)[0])
        if oracle:
            after = _best_outcome(explorer, number, episode.state, condition, config=config, session=session, step=step)
        else:
            chosen = choose_touch(model, episode.state, config=config, seed=step)
            after = None
            if chosen.T_o_t is not None:
                after, _ = update(model, episode.state, session.touch(chosen.T_o_t, condition.evidence))
        if after is None:
            episode.stopped = True
            break
        episode.state = after
    return episode


def _report(episode: Episode, model: SurfaceModel, done: int, *, truth: TrueShape, hidden: np.ndarray | None) -> None:
    estimate = estimate_surface(model, episode.state)
    episode.estimates[done] = estimate
    episode.scores[done] = judge(estimate, truth, hidden)
    errors = surface_errors(estimate, truth)
    episode.errors[done] = SurfaceErrors(errors.distance[::10], errors.std[::10])


def _best_outcome(
    explorer: Explorer,
    number: int,
    state: SurfaceState,
    condition: ExplorationCondition,
    *,
    config: ExplorationConfig,
    session: Session,
    step: int,
) -> SurfaceState | None:
    """The greedy oracle: of a few safe sites, each touched, the one after which the surface is nearest the true one.

    It measures as the signed distance at points of the true surface, which is cheap.
    """
    model = explorer.models[condition.library]
    proposals = choose_touch(model, state, config=config, seed=step).proposals
    sites = proposals.T_o_t[proposals.safe][: explorer.sizes.oracle_sites]
    points = explorer.shapes[number].points
    points = points[:: max(1, len(points) // ORACLE_POINTS)]

    def error(after: SurfaceState) -> float:
        estimate = estimate_surface(model, after, stride=config.stride)
        return float(np.abs(interpolate(estimate.grid, estimate.distance, points)).mean())

    outcomes: list[Any] = [update(model, state, session.touch(site, condition.evidence))[0] for site in sites]
    return min(outcomes, key=error, default=None)
