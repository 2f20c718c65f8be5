"""The emulated arm and skin: presses of the arm change the readings of the skin, by i2t's own physics."""

import os
import signal
import sys
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.refusals import refused

from i2t import dataset
from i2t.collect import command
from i2t.depth.camera import Camera
from i2t.emulators import lab, ur_controller
from i2t.emulators.scene import ROOM_FIELD_UT
from i2t.emulators.world import DEFAULT_PAD_KEY
from i2t.hardware.poses import pose_from_vector
from i2t.hardware.reskin.driver import ReSkin
from i2t.hardware.rig import Rig
from i2t.hardware.ur.driver import UrArm
from i2t.skin.contact import GRID
from i2t.skin.dipoles import rest_field
from i2t.skin.noise import Noise
from i2t.skin.pad import press, sample_pad
from i2t.types import ReturnCode

PATIENCE = 20.0  # s that a loaded machine may need
ABOVE, TOP, STIFFNESS = 0.036, 0.03, 20e3  # m, m, N/m: the star's top is flat, and wider than the skin
SAMPLES = 200
# The emulated board, the thread that hears it and the arm's process share the machine with the other tests: each may
# wait for a core longer than a lab's devices may be silent (0.1 s, 10 Hz and 0.15 s), which no claim here is about.
PATIENT = ["--state-timeout", "3", "--watchdog-rate", "0.5", "--settings.silence", "2", "--settings.hold", "1"]
# Ways are short, and faster than people should stand beside.
QUICK = "prepare=0.01 clearance=0.03 settle=0.02 speed=1 approach=0.1 retreat=1 acceleration=4"
ATTEMPTS = 20  # of a session that a starved device ends: it goes on with the same command

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs the addresses 127.x.y.z")


def down(z):
    return pose_from_vector([0.4, 0.0, z, np.pi, 0.0, 0.0])


@pytest.fixture(scope="module")
def touching(tmp_path_factory):
    """A pair over a star, without errors of placement."""
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed (there are wheels for Python 3.10 to 3.12)")
    host, link = ur_controller.loopback(200), str(tmp_path_factory.mktemp("pair") / "skin")
    options = ["--object", "star", "--no-pose-error", "--stiffness", str(STIFFNESS), "--noise", "0",
               "--pose", "0.4", "0", str(ABOVE), str(np.pi), "0", "0"]  # fmt: skip
    with lab.run_lab("--host", host, "--link", link, *options) as (_, running):
        yield host, link
        running.send_signal(signal.SIGTERM)
        assert running.wait(PATIENCE) == 0
    assert not os.path.islink(link)  # the board has ended too


def settled(skin, wanted, atol):
    """The mean of samples, once they show what the arm does: three processes may wait for a core."""
    end = time.monotonic() + PATIENCE
    while True:
        mean = skin.read(SAMPLES, PATIENCE).reading.mean(0)
        if np.allclose(mean, wanted, rtol=0, atol=atol) or time.monotonic() > end:
            return mean


@pytest.mark.full
def test_a_press_follows_the_physics_with_the_noise_of_its_world(touching):
    pad = jax.jit(sample_pad)(jax.random.key(DEFAULT_PAD_KEY))
    pressed = jax.jit(lambda indentation: press(pad, jnp.zeros((GRID.cells, GRID.cells)), indentation))
    noise = 5 * 4.6 / np.sqrt(SAMPLES)  # uT, five sigma of a mean
    with ReSkin(touching[1]) as skin, UrArm(touching[0], Rig().limits, state_timeout=3.0, watchdog_rate=0.3) as arm:
        assert arm.features.source == skin.features.source == "emulated"
        still = skin.read(2 * SAMPLES, PATIENCE).reading
        ambient = still.mean(0)
        # The pad's own field at rest and the room's.
        room = pad.gains * pad.board.to_board(jnp.tile(ROOM_FIELD_UT @ down(ABOVE)[:3, :3], (pad.board.num_chips, 1)))
        nominal = np.asarray(pad.board.to_board(rest_field(pad)), float) + np.asarray(room)
        np.testing.assert_allclose(ambient, nominal, atol=noise + 0.25)
        np.testing.assert_allclose(still.std(0), Noise().sigma(5), rtol=0.2)  # 400 samples: 3.5 % of one sigma
        arm.zero_wrench(PATIENCE)
        for force in (1.0, 6.0):
            done = arm.approach(0.03, 0.01, force=force, acceleration=0.2)
            assert done.reason == "force"
            assert -done.state.wrench[2] > force
            np.testing.assert_allclose(done.state.wrench[:2], 0.0, atol=1e-6)
            # What the tool travelled past the top is the skin's indentation and the give of arm and mount.
            felt, sunk = -done.state.wrench[2], TOP - (ABOVE - done.distance)
            expected = pressed(jnp.asarray(sunk - felt / STIFFNESS, jnp.float32))
            # Force and reading lie between those of loads a factor of 1.85 apart, and for a flat on straight lines. It
            # is stiff: 3 % of 6 N are a micrometre of indentation.
            assert felt == pytest.approx(float(expected.force), rel=0.03)
            wanted = np.asarray(expected.reading)
            assert np.linalg.norm(wanted) > 10  # uT, so that there is something to compare
            atol = noise * np.sqrt(2) + 0.03 * abs(wanted).max()
            np.testing.assert_allclose(settled(skin, ambient + wanted, atol) - ambient, wanted, atol=atol)
            arm.go(down(ABOVE), 0.1)
        after = settled(skin, ambient, noise * np.sqrt(2))
        np.testing.assert_allclose(after, ambient, atol=noise * np.sqrt(2))
        assert skin.counters.loss < 0.02  # a loaded machine loses some; none of what is compared is one sample


@pytest.mark.full
def test_the_command_collects_with_an_arm_by_its_address_and_a_skin_by_its_port(touching, tmp_path, capsys):
    """As a lab types it: the real drivers, and a simulated camera."""
    (host, link), out = touching, tmp_path / "touched"
    rig = replace(Rig(), camera=Camera(160, 90, 80.6, 80.5, 79.5, 44.5))
    rig = replace(rig, limits=replace(rig.limits, stiffness=500.0, force=100.0, speed=1.0, acceleration=4.0))
    rig.write(tmp_path / "lab.toml")
    quick = [f"--settings.{setting}" for setting in QUICK.split()]
    words = ["--arm", "ur", "--host", host, "--skin", "reskin", "--port", link, "--rig", str(tmp_path / "lab.toml"),
             "--object", "star", "--camera", "simulated", "--no-pose-error", "--touches", "1",
             *PATIENT, *quick]  # fmt: skip
    assert any(command.main(["--out", str(out), *words]) == 0 for _ in range(ATTEMPTS))
    assert "SIMULATED: no real device takes part" in capsys.readouterr().out  # a pseudo-terminal is no lab
    collected = dataset.load_dataset(out)
    assert collected.source == "simulated"
    assert collected.meta["arm serial number"] == "20200000001"  # as the controller's dashboard tells it
    touches = collected.touches
    assert touches.code[0] in (ReturnCode.SKIN, ReturnCode.WRENCH)
    assert np.linalg.norm(touches.reading[0]) > 10
    assert 0.026 < touches.T_w_t[0, 2, 3] < 0.0305  # the star's flat top, less what skin, arm and mount give
    seen = touches.patch[0][np.isfinite(touches.patch[0])]
    assert np.abs(np.median(seen)) < 1e-3  # the view shows the site where the arm went


def test_impossible_options_are_refused_in_one_sentence(tmp_path, capsys):
    Rig().write(tmp_path / "lab.toml")
    for options, why in (
        (["--object", "nothing.stl"], "nothing.stl"),
        (["--rig", str(tmp_path / "nowhere.toml")], "no such file"),
        (["--pad", str(tmp_path / "nowhere.npz")], "nowhere.npz"),
        (["--rig", str(tmp_path / "lab.toml"), "--carried", "right", "link"], "the rig has no skin right"),
    ):
        words = ["--host", ur_controller.loopback(202), "--link", tmp_path / "skin", *options]
        refused(capsys, lab.main, *words, why=why)
