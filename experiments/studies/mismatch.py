"""Cost of a world whose physics is not the belief's.

The belief stays as it is: fitted to touches of the matched world, its predictions those of the bonded elastic layer.
The test episodes are simulated in other worlds, with common random numbers, one thing different in each; every row's
difference to the matched world is paired.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.common.runs import Part
from experiments.recognize.trained_run import meshes_by_name
from experiments.studies import free_sides
from experiments.studies.lab import StudyLab
from i2t.geometry import from_twist
from i2t.objects import Mesh
from i2t.recognition.episodes import EpisodeConfig, run_belief, run_episodes
from i2t.recognition.site_pool import prepare_surfaces
from i2t.simulation.press import PressLaw, PressLimits
from i2t.simulation.touches import SimulationErrors
from i2t.skin import faults
from i2t.skin.contact import GRID, Grid
from i2t.skin.dipoles import MICROTESLA, dipole_field, rest_field, sheets, turn
from i2t.skin.faults import Faults
from i2t.skin.pad import Press
from i2t.skin.pad import press as press_pad
from i2t.types import TWIST_LEVER_M, Board, Pad

SHOWN_KINDS = ("fused", "readings")
MATCHED = "matched"
EDGE_RADIUS_M = 0.5e-3  # of rounded edges
REMOUNTED_M = np.array([0.3e-3, 0.4e-3, 0.0])  # by 0.5 mm, chips against the skin
CAMERA_BIAS = np.array([0.6e-3, -0.6e-3, 0.6e-3, *(TWIST_LEVER_M * np.radians([0.6, 0.6, -0.6]))])  # 1 mm, 1 degree
MESH_PERCENT = (-3, -1, 1, 3)
DEBUG_WORLDS = (MATCHED, "Winkler foundation", "meshes 3 % larger")


@dataclass(frozen=True)
class MismatchedWorld:
    """Differences from the matched world."""

    pad: Callable[[Pad], Pad] = field(default=lambda pad: pad)
    mesh: Callable[[Mesh], Mesh] = field(default=lambda mesh: mesh)
    errors: Callable[[SimulationErrors], SimulationErrors] = field(default=lambda errors: errors)
    limits: Callable[[PressLimits], PressLimits] = field(default=lambda limits: limits)
    law: Callable[[Pad], PressLaw] = field(default=lambda _: press_pad)


# --- worlds ---


def winkler_press(
    pad: Pad, height: Float[Array, "n n"], indentation: Float[Array, ""] | float, grid: Grid = GRID
) -> Press:
    """A press of a skin whose columns are springs that know nothing of each other (a Winkler foundation): each is
    shortened evenly by as far as the surface reaches into it, p = E u / h, and moves its magnets straight down.
    """
    compression = jnp.maximum(indentation - height, 0.0)
    pressure = pad.young / pad.thickness * compression
    reading = pad.gains * pad.board.to_board(_column_field(pad, _on_grid(compression, grid)) - rest_field(pad, GRID))
    force = jnp.sum(pressure) * grid.spacing**2
    return Press(reading, force, jnp.asarray(indentation), pressure, jnp.asarray(True))


def rounded_press(
    pad: Pad, height: Float[Array, "n n"], indentation: Float[Array, ""] | float, grid: Grid = GRID
) -> Press:
    """A press on a surface whose edges are rounded, as if a ball of EDGE_RADIUS_M had rolled inside it everywhere."""
    return press_pad(pad, opened_by_ball(height, EDGE_RADIUS_M, grid.spacing), indentation, grid=grid)


def opened_by_ball(height: Float[Array, "n n"], radius: float, spacing: float) -> Float[Array, "n n"]:
    """Heights of what lies behind a surface, opened by a ball (Sternberg, Computer 16, 1983): all balls that fit behind
    it, and nothing else. Beyond the edge of the array the surface goes on as it ends there.

    Args:
        height: Of the surface (m); what is there lies above it.
        radius: Of the ball (m).
        spacing: Of the cells (m).

    Returns:
        Heights of the opened surface, nowhere lower than before.
    """
    reach = int(radius / spacing + 1e-6)
    steps = range(-reach, reach + 1)
    offsets = [(i, j) for i in steps for j in steps if (i * i + j * j) * spacing**2 <= radius**2]
    caps = [float(np.sqrt(radius**2 - (i * i + j * j) * spacing**2)) for i, j in offsets]
    n = len(height)

    def around(values: Array) -> list[Array]:
        padded = jnp.pad(values, reach, mode="edge")
        return [padded[reach + i : reach + i + n, reach + j : reach + j + n] for i, j in offsets]

    lowest = [values + cap for values, cap in zip(around(height), caps, strict=True)]
    centre = jnp.max(jnp.stack(lowest), axis=0)  # the lowest that a ball can be
    return jnp.min(jnp.stack([values - cap for values, cap in zip(around(centre), caps, strict=True)]), axis=0)


def _on_grid(values: Float[Array, "n n"], grid: Grid) -> Float[Array, "m m"]:
    """Means over the cells of GRID, whose cells are whole ones of `grid`."""
    each = grid.cells // GRID.cells
    return values.reshape(GRID.cells, each, GRID.cells, each).mean((1, 3))


def _column_field(pad: Pad, compression: Float[Array, "m m"]) -> Float[Array, "chips 3"]:
    """Field (uT, tool axes) at the chips of columns shortened evenly by `compression` (m): a magnet at a part of the
    height moves down by that part, and turns with half the curl of that motion.
    """
    y, x = np.meshgrid(GRID.centres, GRID.centres, indexing="ij")
    along_y, along_x = (jnp.asarray(jnp.gradient(compression, GRID.spacing, axis=axis)) for axis in (0, 1))

    def sheet(magnets: tuple[Array, Array]) -> Array:
        depth, moments = magnets
        part = 1 - depth / pad.thickness
        position = jnp.stack([jnp.asarray(x), jnp.asarray(y), -depth - part * compression])
        rotation = part / 2 * jnp.stack([-along_y, along_x, jnp.zeros_like(compression)])
        turned = turn(rotation, moments)
        return dipole_field(jnp.asarray(pad.board.chips), position.reshape(3, -1).T, turned.reshape(3, -1).T)

    return MICROTESLA * jnp.sum(jax.lax.map(sheet, sheets(pad, GRID)), axis=0)


def _scaled(mesh: Mesh, factor: float) -> Mesh:
    return mesh._replace(vertices=np.asarray(mesh.vertices) * factor)


def _shifted(mesh: Mesh, twist: np.ndarray) -> Mesh:
    T = np.asarray(from_twist(jnp.float32(twist)), float)
    return mesh._replace(vertices=np.asarray(mesh.vertices) @ T[:3, :3].T + T[:3, 3])


def _misplaced(errors: SimulationErrors, factor: float) -> SimulationErrors:
    return replace(
        errors, placement=factor * errors.placement, placement_angle=factor * errors.placement_angle
    )  # fmt: skip


def _faulty(errors: SimulationErrors, **faults: Any) -> SimulationErrors:
    return replace(errors, faults=replace(errors.faults, **faults))


def _remounted(pad: Pad) -> Pad:
    board = Board(jnp.asarray(pad.board.chips) + jnp.asarray(REMOUNTED_M, jnp.float32)[None], pad.board.rotations)
    return pad._replace(board=board)


def remembering_chip(pad: Pad) -> int:
    """The chip of a pad's board that keeps a part of the press before: the one that reads after a press of all."""
    return int(_remembering_chip(pad))


@jax.jit
def _remembering_chip(pad: Pad) -> Array:
    presses = jnp.stack([jnp.ones(pad.board.num_readings), jnp.zeros(pad.board.num_readings)])
    poses, key_board = jnp.tile(jnp.eye(4), (2, 1, 1)), faults.board_key(pad.gains)
    read = faults.apply(jax.random.key(0), presses, poses, pad.board, Faults(hysteresis=1.0), key_board=key_board)
    return jnp.argmax(jnp.abs(read[1])) // 3


def with_another_memory(pad: Pad) -> Pad:
    """The pad on a board that differs in nothing that can be read but in the chip that remembers, and in its drifts: a
    board is known by its gains, which differ by less than a part in ten thousand.
    """
    others = (pad._replace(gains=pad.gains * (1 + 1e-6 * (i + 1))) for i in range(100))
    return next(other for other in others if remembering_chip(other) != remembering_chip(pad))


def worlds() -> dict[str, MismatchedWorld]:
    """The worlds by name; the first is the one that the belief knows."""
    return {
        MATCHED: MismatchedWorld(),
        "Winkler foundation": MismatchedWorld(law=lambda _: winkler_press),
        "free side faces": MismatchedWorld(law=free_sides.press_law),
        "soft compressible layer": MismatchedWorld(
            pad=lambda pad: pad._replace(young=0.6 * pad.young, poisson=jnp.float32(0.3))
        ),
        "worn pad": MismatchedWorld(
            pad=lambda pad: pad._replace(young=0.7 * pad.young, magnetization=0.9 * pad.magnetization),
            errors=partial(_faulty, relaxation=0.15),
        ),
        "chip remembers twice as much": MismatchedWorld(errors=partial(_faulty, hysteresis=0.6)),
        "another chip remembers": MismatchedWorld(pad=with_another_memory),
        "ambient once, before the episode": MismatchedWorld(errors=partial(_faulty, ambient_every=0)),
        "arm twice as stiff": MismatchedWorld(limits=lambda limits: replace(limits, stiffness=2 * limits.stiffness)),
        "arm half as stiff": MismatchedWorld(limits=lambda limits: replace(limits, stiffness=limits.stiffness / 2)),
        "edges rounded by 0.5 mm": MismatchedWorld(law=lambda _: rounded_press),
        **{
            f"meshes {abs(percent)} % {'larger' if percent > 0 else 'smaller'}": MismatchedWorld(
                mesh=partial(_scaled, factor=1 + percent / 100)
            )
            for percent in MESH_PERCENT
        },
        "skin remounted by 0.5 mm": MismatchedWorld(pad=_remounted),
        "camera biased by 1 mm and degree": MismatchedWorld(mesh=partial(_shifted, twist=CAMERA_BIAS)),
        "placement off twice as far as stated": MismatchedWorld(errors=partial(_misplaced, factor=2.0)),
        "placement off half as far as stated": MismatchedWorld(errors=partial(_misplaced, factor=0.5)),
    }


# --- the study ---


def evaluate(lab: StudyLab) -> Part:
    """Beliefs of the matched world in the episodes of every world, with common random numbers."""
    key_sites, key_episodes = jax.random.split(lab.key)
    plan, particles = lab.plan(key_sites), lab.particles()
    (table,) = lab.predict(plan.sites, particles, [lab.pad_model.reading_model], MATCHED)
    meshes = list(meshes_by_name(lab.names).values())
    some = {name: world for name, world in worlds().items() if not lab.args.debug or name in DEBUG_WORLDS}
    # All worlds' surfaces at once: they are of one size class, and compiled for once.
    prepared = iter(prepare_surfaces([world.mesh(mesh) for world in some.values() for mesh in meshes]))
    found: dict[str, np.ndarray] = {"truth": plan.truth, "pool": plan.pool}
    for name, world in some.items():
        pad = world.pad(lab.run.pad)
        config = EpisodeConfig(
            world.errors(lab.cfg.errors), world.limits(lab.cfg.limits), plan.chosen.shape[1], law=world.law(pad)
        )
        episodes = run_episodes(
            jax.random.clone(key_episodes), [next(prepared) for _ in meshes], plan.truth, plan.chosen,
            sites=plan.sites, pad=pad, config=config, label=name,
        )  # fmt: skip
        beliefs = run_belief(table, episodes, lab.pad_model.likelihood, particles, SHOWN_KINDS)
        found |= {f"{kind}, {name}": p for kind, p in beliefs.items()}
    return found
