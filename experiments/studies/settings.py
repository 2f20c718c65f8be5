"""The studies that are tables of settings (`experiments.studies.lab`): what is varied, and over which values.

mismatch     the world differs from what the belief was fitted to, in one thing at a time, and the belief stays; where
             the physics of the skin is another one, a belief that was fitted there is compared with it;
sensitivity  the world's errors, noise and presses differ, and the belief knows how large they are;
new_pad      a pad that was never recorded is pressed with a known ball, and a pad is fitted to its readings
             (`i2t.calibration.physics`). A pad model is fitted to simulated touches with that pad, and errs as much
             more as the pad is off presses left out.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.studies import free_sides
from experiments.studies.lab import Setting, StudyLab, StudyWorld
from experiments.studies.winkler import winkler_press
from i2t.calibration.physics import PadFit, Presses, RoundTip, fit_pad
from i2t.geometry import from_twist
from i2t.objects import Mesh
from i2t.recognition.pad_model import PadModel, inflated, with_press_errors
from i2t.simulation.touches import SimulationErrors
from i2t.skin.contact import GRID
from i2t.skin.noise import Noise, add_sensor_noise
from i2t.skin.pad import press_force, sample_pad
from i2t.types import Board, Pad
from i2t.windows import TWIST_LEVER_M

WITH_READINGS = ("fused", "readings")
WITH_PRESENCE = ("fused", "readings and presence")
REMOUNTED_M = np.array([0.3e-3, 0.4e-3, 0.0])  # by 0.5 mm, chips against the skin
CAMERA_BIAS = np.array([0.6e-3, -0.6e-3, 0.6e-3, *(TWIST_LEVER_M * np.radians([0.6, 0.6, -0.6]))])  # 1 mm, 1 degree
MESH_PERCENT = (-3, -1, 1, 3)
OTHER_PHYSICS = ("Winkler foundation", "free side faces", "soft compressible layer")  # to which a pad model is fitted
DEBUG_WORLDS = ("matched", "Winkler foundation", "Winkler foundation, fitted there", "meshes 3 % larger")

REFITTED_UT = (50.0, 100.0)  # at which presses stop that a pad model is fitted to, too
AMBIENT_EVERY = (5, 20)  # touches; an episode of ten has one in its first touch at 20
FOLLOWED_DRIFT_UT = 20.0  # of the order of the earth's field (48 uT) on one axis while the tool turns between touches
MIN_PLACEMENT_M, MIN_PLACEMENT_RAD = 0.02e-3, np.radians(0.02)  # spread of pose particles where poses are exact
DEBUG_ERRORS = ("default", "stop at 50 uT", "stop at 50 uT, fitted there")

PRESS_COUNTS = (5, 20, 100)
BALL = RoundTip("sphere", 4e-3)
FIRST_NEW_PAD_SEED = 5000  # of the pads that were never recorded, apart from those of the runs
PRESS_HALF_WIDTH_M = 8e-3
PRESS_FORCES_N = (0.2, 1.0)
FORCE_NOISE_N = 0.02


def _placed(errors: SimulationErrors, factor: float) -> SimulationErrors:
    """Errors of placement larger by a factor."""
    return replace(errors, placement=factor * errors.placement, placement_angle=factor * errors.placement_angle)


def faulty(errors: SimulationErrors, **faults: Any) -> SimulationErrors:
    """Errors with other faults of the sensor."""
    return replace(errors, faults=replace(errors.faults, **faults))


def _noiseless(errors: SimulationErrors) -> SimulationErrors:
    """The errors without those of the skin, the wrench and the camera."""
    return replace(
        SimulationErrors.none(), placement=errors.placement, placement_angle=errors.placement_angle,
        repeatability=errors.repeatability, approach_angle=errors.approach_angle, slant=errors.slant,
    )  # fmt: skip


def _scaled(mesh: Mesh, factor: float) -> Mesh:
    return mesh._replace(vertices=np.asarray(mesh.vertices) * factor)


def _shifted(mesh: Mesh) -> Mesh:
    T = np.asarray(from_twist(jnp.float32(CAMERA_BIAS)), float)
    return mesh._replace(vertices=np.asarray(mesh.vertices) @ T[:3, :3].T + T[:3, 3])


def mismatch(lab: StudyLab, key: Array) -> dict[str, Setting]:
    """Worlds of which the belief knows nothing but for the first, and those of another physics with a pad model that is
    fitted to touches there.
    """
    errors, limits, pad = lab.cfg.errors, lab.cfg.limits, lab.run.pad
    chips = jnp.asarray(pad.board.chips) + jnp.asarray(REMOUNTED_M, jnp.float32)[None]
    worn = pad._replace(young=0.7 * pad.young, magnetization=0.9 * pad.magnetization)
    worlds = {
        "matched": StudyWorld(),
        "Winkler foundation": StudyWorld(law=lambda _: winkler_press),
        "free side faces": StudyWorld(law=free_sides.press_law),
        "soft compressible layer": StudyWorld(pad=pad._replace(young=0.6 * pad.young, poisson=jnp.float32(0.3))),
        "worn pad": StudyWorld(pad=worn, errors=faulty(errors, relaxation=0.15)),
        "chip remembers twice as much": StudyWorld(errors=faulty(errors, hysteresis=0.6)),
        "ambient once, before the episode": StudyWorld(errors=faulty(errors, ambient_every=0)),
        "arm twice as stiff": StudyWorld(limits=replace(limits, stiffness=2 * limits.stiffness)),
        "arm half as stiff": StudyWorld(limits=replace(limits, stiffness=0.5 * limits.stiffness)),
        **{
            f"meshes {abs(percent)} % {'larger' if percent > 0 else 'smaller'}": StudyWorld(
                mesh=partial(_scaled, factor=1 + percent / 100)
            )
            for percent in MESH_PERCENT
        },
        "skin remounted by 0.5 mm": StudyWorld(pad=pad._replace(board=Board(chips, pad.board.rotations))),
        "camera biased by 1 mm and degree": StudyWorld(mesh=_shifted),
        "placement off twice as far as stated": StudyWorld(errors=_placed(errors, 2.0)),
        "placement off half as far as stated": StudyWorld(errors=_placed(errors, 0.5)),
    }
    found = {name: Setting(world, WITH_READINGS, lab.pad_model, errors) for name, world in worlds.items()}
    for i, name in enumerate(OTHER_PHYSICS[:1] if lab.args.debug else OTHER_PHYSICS):
        model = lab.refit(jax.random.fold_in(key, i), worlds[name])
        found[f"{name}, fitted there"] = found[name]._replace(model=model)
    return {name: each for name, each in found.items() if name in DEBUG_WORLDS or not lab.args.debug}


def sensitivity(lab: StudyLab, key: Array) -> dict[str, Setting]:
    """Worlds whose errors the belief knows; of harder presses with the run's pad model, and with one fitted to them."""
    base = lab.cfg.errors
    errors = {
        "default": base,
        "placement 0.3 mm, 0.3 deg": replace(base, placement=0.3e-3, placement_angle=np.radians(0.3)),
        "placement 2 mm, 2 deg": replace(base, placement=2e-3, placement_angle=np.radians(2.0)),
        "tilt 1 deg": replace(base, approach_angle=np.radians(1.0)),
        "noise x 3": replace(base, noise=base.noise.scaled(3.0)),
        **{f"stop at {stop:.0f} uT": base for stop in REFITTED_UT},
        **{f"ambient every {each} touches": faulty(base, ambient_every=each) for each in AMBIENT_EVERY},
        "no errors of pose": base.scaled(0.0),
        "no noise, no faults": _noiseless(base),
    }
    limits = {f"stop at {stop:.0f} uT": replace(lab.cfg.limits, skin_change=stop) for stop in REFITTED_UT}
    found = {}
    for name, each in errors.items():
        stated = replace(
            each,
            placement=max(each.placement, MIN_PLACEMENT_M),
            placement_angle=max(each.placement_angle, MIN_PLACEMENT_RAD),
        )
        world = StudyWorld(errors=each, limits=limits.get(name))
        found[name] = Setting(world, WITH_PRESENCE, noisier(lab, each), stated)
    for every in AMBIENT_EVERY:
        usual = found[f"ambient every {every} touches"]
        following = lab.pad_model.likelihood._replace(drift_std=jnp.float32(FOLLOWED_DRIFT_UT))
        model = lab.pad_model._replace(likelihood=following)
        found[f"ambient every {every} touches, drift followed"] = usual._replace(model=model)
    for stop in REFITTED_UT[:1] if lab.args.debug else REFITTED_UT:
        name = f"stop at {stop:.0f} uT"
        model = lab.refit(jax.random.fold_in(key, int(stop)), StudyWorld(limits=limits[name]))
        found[f"{name}, fitted there"] = found[name]._replace(model=model)
    return {name: each for name, each in found.items() if name in DEBUG_ERRORS or not lab.args.debug}


def noisier(lab: StudyLab, errors: SimulationErrors) -> PadModel:
    """The run's pad model, its errors wider where the noise is more than that of the touches it was fitted to."""
    wider = max(errors.noise.xy / lab.cfg.errors.noise.xy, 1.0)
    return inflated(lab.pad_model, wider)


def new_pad(lab: StudyLab, key: Array) -> dict[str, Setting]:
    """Pad models that know a pad better and better: another pad's, those of pads fitted to some presses, its own."""
    board = lab.run.dataset.board
    pad = sample_pad(jax.random.key(FIRST_NEW_PAD_SEED + lab.seed), board=board)
    models = {"another pad's": lab.pad_model}
    for n in PRESS_COUNTS[:1] if lab.args.debug else PRESS_COUNTS:
        key_press, key_model = jax.random.split(jax.random.fold_in(key, n))
        fitted = press_and_fit(key_press, pad, n, board)
        error_std = float(jnp.sqrt(jnp.mean(fitted.leave_one_out**2)))
        models[f"{n} presses"] = with_press_errors(lab.refit(key_model, StudyWorld(pad=fitted.pad)), error_std)
    world = StudyWorld(pad=pad)
    models["the pad itself"] = lab.refit(jax.random.fold_in(key, 0), world)
    found = {name: Setting(world, WITH_PRESENCE, model, lab.cfg.errors) for name, model in models.items()}
    return found | {"": Setting(world, ("position and presence",), lab.pad_model, lab.cfg.errors)}


def press_and_fit(key: Array, pad: Pad, n: int, board: Board) -> PadFit:
    """Press a pad n times with a known ball, and fit one to its readings; `board` is its nominal one."""
    key_position, key_force, key_noise, key_wrench = jax.random.split(key, 4)
    position = jax.random.uniform(key_position, (n, 2), minval=-PRESS_HALF_WIDTH_M, maxval=PRESS_HALF_WIDTH_M)
    force = jax.random.uniform(key_force, (n,), minval=PRESS_FORCES_N[0], maxval=PRESS_FORCES_N[1])
    clean = jax.lax.map(lambda at: press_force(pad, BALL.height(at[0], GRID), at[1]).reading, (position, force))
    readings = jax.vmap(lambda k, r: add_sensor_noise(k, r, pad.board, Noise()))(jax.random.split(key_noise, n), clean)
    presses = Presses(position, force + FORCE_NOISE_N * jax.random.normal(key_wrench, (n,)))
    return fit_pad(presses, readings, tip=BALL, board=board, by_force=True)
