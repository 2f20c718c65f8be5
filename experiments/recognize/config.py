"""Settings of the recognition experiments, all of which were fixed before testing."""

from dataclasses import dataclass, field

from i2t.contact.press import PressLimits
from i2t.simulation import sites as touch_sites
from i2t.simulation.touches import SimulationErrors
from i2t.skin.contact import FINE_GRID


@dataclass(frozen=True)
class Recognition:
    """Objects, numbers of episodes, and settings of the simulation."""

    primitives: tuple[str, ...] = ("square", "star", "cylinder")
    tools: tuple[str, ...] = ("screwdriver", "hammer")
    validation: tuple[str, ...] = ("pentagon", "octagon", "flower", "marker", "pliers")
    touches: int = 10  # of each episode
    episodes: int = 80  # of each object, in the set of all objects
    paper_episodes: int = 200  # of each object, in each of the paper's sets
    own_episodes: int = 40  # of each object of --objects
    validation_episodes: int = 40  # of each validation object, for temperatures and conformal sets
    num_sites: int = 24  # sites of each object in the pool of a recogniser or a study
    pool_sites: int = 100  # sites of each object in each pool of the paper's heuristic
    pool_episodes: int = 5  # episodes that share such a pool
    num_particles: int = 128  # poses of each object
    errors: SimulationErrors = field(default_factory=SimulationErrors)
    limits: PressLimits = field(default_factory=lambda: PressLimits(final=FINE_GRID))
    site_limits: touch_sites.SiteLimits = touch_sites.RECOGNITION_LIMITS

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of all test objects."""
        return self.primitives + self.tools


PRESETS: dict[str, Recognition] = {
    "short": Recognition(
        episodes=4, paper_episodes=5, own_episodes=4, validation_episodes=4, num_particles=32, pool_episodes=1
    ),
    "paper": Recognition(),
    "debug": Recognition(  # the same number of episodes in each set, so that they compile once
        primitives=("square", "cylinder"),
        tools=("screwdriver", "hammer"),
        validation=("flower", "spanner"),
        touches=3,
        episodes=3,
        paper_episodes=6,
        own_episodes=3,
        validation_episodes=6,
        num_sites=3,
        pool_sites=10,
        pool_episodes=2,
        num_particles=16,
        limits=PressLimits(),
    ),
}
