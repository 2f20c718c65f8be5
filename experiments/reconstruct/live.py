"""An arm explores an unknown object: each touch goes where it is expected to tell most of the surface, through the
procedure that collects data (`i2t.collect.session`). The touches are kept in OUT/touches.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from experiments.reconstruct.arguments import ReconstructArgs
from experiments.reconstruct.world import split_objects
from i2t.collect import session
from i2t.collect.arguments import ArmArgs, CollectArgs, SkinArgs, WorldArgs
from i2t.collect.settings import TouchSettings
from i2t.collect.touch import Site, SiteOutcome
from i2t.geometry import inverse
from i2t.hardware.rig import Rig
from i2t.recognition.recognizer import MAX_EMPTY_DRAWS
from i2t.reconstruction.exploration import ExplorationConfig, choose_touch
from i2t.reconstruction.surface import SurfaceModel, contact_evidence, init, surface_model, update
from i2t.types import ReturnCode

UNKNOWN = "unknown"  # name of the object, in the data set
LIVE_OVERTRAVEL_M = 4e-3  # beyond a site: more would end in the table next to a low object
UNKNOWN_WITHIN_M = 16e-3  # before a site the surface may be: there the slow approach begins
MAX_FAILURES = 10  # of sites in a row


class Exploration:
    """Exploration that chooses the procedure's sites and learns from the touches made there."""

    def __init__(self, model: SurfaceModel, settings: TouchSettings, *, seed: int, touches: int) -> None:
        self.model, self.seed, self.touches = model, seed, touches
        self.rig = Rig()
        self.T_w_o = np.asarray(self.rig.T_world_object, np.float64)
        self.failures = 0  # since the last touch
        self.approach = settings.prepare
        self.config = ExplorationConfig(approach=settings.prepare, overtravel=settings.overtravel)
        self.state, _ = init(model)

    def choose(self, history: Sequence[SiteOutcome]) -> Site | None:
        """The next site; None when all touches were made, or where nothing is allowed."""
        if len(self.state.touches) >= self.touches:
            return None
        for draw in range(MAX_EMPTY_DRAWS if self.failures < MAX_FAILURES else 0):
            step = int(np.random.SeedSequence([self.seed, len(history), draw]).generate_state(1)[0])
            T_o_t = choose_touch(self.model, self.state, config=self.config, seed=step).T_o_t
            if T_o_t is not None and self.within(self.T_w_o @ T_o_t):
                return Site(len(history), self.T_w_o @ T_o_t)
        print("  stopped: no touch is allowed on what the object may be", flush=True)
        return None

    def within(self, T_w_t: Float[np.ndarray, "4 4"]) -> bool:
        """Test whether the arm may go to the end of a press that meets nothing."""
        end = T_w_t[:3, 3] + self.config.overtravel * T_w_t[:3, 2]
        return self.rig.limits.contains((self.rig.T_base_world @ np.append(end, 1.0))[:3])

    def learn(self, outcome: SiteOutcome) -> None:
        """Update the surface with a touch: where it met it, or the way that was free."""
        touch = outcome.touch
        self.failures = 0 if touch else self.failures + 1
        if touch is None:
            return
        T_o_t, hit = inverse(self.T_w_o) @ np.asarray(touch.T_w_t, np.float64), touch.code != ReturnCode.AIR
        if hit:
            T_o_t[:3, 3] -= touch.depth * T_o_t[:3, 2]
        self.state, info = update(self.model, self.state, contact_evidence(T_o_t, hit=hit, swept=self.approach))
        print(f"  as sure of the shape as among {info.effective_shapes:.0f} of the library", flush=True)


def explore(args: ReconstructArgs) -> Path:
    """Touch the object.

    Args:
        args: With --arm and --true-object.

    Returns:
        The folder of its touches.

    Raises:
        ValueError: No touch was made.
    """
    sizes = args.sizes
    settings = TouchSettings(overtravel=LIVE_OVERTRAVEL_M, near=UNKNOWN_WITHIN_M, surface_tolerance=UNKNOWN_WITHIN_M)
    model = surface_model([each.mesh for each in split_objects(args, sizes).train])
    exploration = Exploration(model, settings, seed=args.seed, touches=sizes.touches)
    folder = args.out / "touches"
    collected = CollectArgs(
        out=folder,
        touches=sizes.touches,
        arm=ArmArgs(str(args.arm)),
        skin=SkinArgs(str(args.arm)),
        world=WorldArgs(str(args.true_object), seed=args.seed),
        name=UNKNOWN,
        skip_first_touch=True,  # nobody knows what stands there, so that it would contradict any mesh
        settings=settings,
    )
    code = session.collect(collected, exploration.choose, exploration.learn)
    if code or not exploration.state.touches:
        raise ValueError("no touch was made, so nothing is known of the surface")
    return folder
