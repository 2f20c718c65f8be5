"""Plug-ins of simulated and emulated devices (`i2t.hardware.plugins`), declared like those of other packages.

Simulated devices share a lab (`i2t.emulators.in_process`), which the arm holds. If all devices are simulated, their
time is virtual and passes without waiting. Emulated devices are the real drivers with emulators in processes of their
own (`i2t.emulators.lab`), which the arm starts if no address is given. Nothing large is imported before a device is
built.
"""

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from i2t.emulators.world import make_scene, read_pad
from i2t.hardware.clock import Clock
from i2t.hardware.drivers import make_reskin, make_ur, reskin, ur
from i2t.hardware.plugins import DevicePlugin, DeviceSetup
from i2t.hardware.ur.access import is_on_this_machine
from i2t.hardware.ur.driver import EMULATED_WATCH
from i2t.skin.boards import DEFAULT_BOARD

if TYPE_CHECKING:
    from i2t.emulators.in_process import SimulatedArm, SimulatedCamera, SimulatedSkin
    from i2t.hardware.reskin.driver import ReSkin
    from i2t.hardware.ur.driver import UrArm


def virtual_clock(begin: float) -> Clock:
    """Make the clock of simulated devices, whose waits advance its time at once.

    Args:
        begin: Earliest Unix time (s) at which the clock may begin.

    Returns:
        A virtual clock that begins now, or at `begin` if that is later.
    """
    from i2t.emulators.in_process import VirtualClock

    return VirtualClock(max(time.time(), begin))


def make_simulated_arm(setup: DeviceSetup) -> "SimulatedArm":
    """Make a simulated arm in a simulated lab of its own.

    Args:
        setup: The world, the rig, and the board of the skin that the arm carries.

    Returns:
        The arm, whose lab is `arm.lab`.
    """
    from i2t.emulators.in_process import SimulatedArm, SimulatedLab

    world = setup.world
    lab = SimulatedLab(make_scene(world, setup.rig, setup.board), setup.clock, seed=world.seed)
    return SimulatedArm(lab, setup.rig.limits)


def make_simulated_skin(setup: DeviceSetup) -> "SimulatedSkin":
    """Make a simulated skin on a simulated arm. A further skin on the tool has a random pad of its own.

    Args:
        setup: The set-up, with the simulated arm that carries the skin.

    Returns:
        The skin, not connected.
    """
    from i2t.emulators.in_process import SimulatedSkin, SkinInLab

    lab, place, world, number = _lab_of(setup.arm), setup.skin, setup.world, _number_of(setup)
    if place is None or not number:
        return SimulatedSkin(lab)
    scene = make_scene(world, setup.rig, place.board, number)
    return SimulatedSkin(lab, lab.carry(SkinInLab(scene, place.T_tool_skin, world.seed + number)))


def make_simulated_camera(setup: DeviceSetup) -> "SimulatedCamera":
    """Make a simulated camera on a simulated or emulated arm.

    Args:
        setup: The set-up, with the arm that carries the camera.

    Returns:
        The camera. It sees the scene of the arm's lab, or the object of the world if the arm has no lab.

    Raises:
        ValueError: If there is no arm.
    """
    from i2t.depth.camera import Distortion
    from i2t.emulators.in_process import SimulatedCamera

    arm, rig = setup.arm, setup.rig
    if arm is None:
        raise ValueError("a simulated camera is carried by an arm; pass --arm simulated")
    lab = getattr(arm, "lab", None)
    scene = lab.scene if lab is not None else make_scene(setup.world, rig, setup.board)
    lens = replace(rig.camera, model=Distortion.NONE, coefficients=())
    return SimulatedCamera(
        scene, lens, rig.T_tool_camera, lambda: arm.state().T_b_t, setup.clock, seed=setup.world.seed
    )


def make_emulated_arm(setup: DeviceSetup) -> "UrArm":
    """Make the driver of a real UR arm, connected to an emulated controller whose tool carries emulated skins.

    Args:
        setup: The set-up, with the address of a running lab; without an address, one is started with the rig's emulated
            skins.

    Returns:
        The arm, not connected. On this machine, its timeouts are by default those of `EMULATED_WATCH`; a controller at
        any other address may move a real arm, which keeps its safety limits.

    Raises:
        ValueError: If the pad is on another board than the skin.
    """
    if setup.address and not is_on_this_machine(setup.address):
        return make_ur(setup)
    setup = replace(setup, watch={**EMULATED_WATCH, **setup.watch})
    if setup.address:
        return make_ur(setup)
    from i2t.emulators import lab, ur_controller

    world, board = setup.world, setup.board or DEFAULT_BOARD
    if world.pad:
        read_pad(world.pad, board)  # refuses a pad on another board before a process starts
    folder, host = (
        Path(setup.stack.enter_context(tempfile.TemporaryDirectory())),
        ur_controller.loopback(200),
    )
    setup.rig.write(folder / "rig.toml")
    options = ["--host", host, "--rig", str(folder / "rig.toml"), "--link", str(folder / "0"), "--board", board]
    for number, place in enumerate(setup.rig.skins, start=1):
        if place.device == "emulated":
            options += ["--carried", place.name, str(folder / str(number))]
    for name, value in vars(world).items():
        if value not in (None, False):
            options += [f"--{name.replace('_', '-')}", *([] if value is True else [str(value)])]
    setup.stack.enter_context(lab.run_lab(*options))
    arm: Any = make_ur(replace(setup, address=host))
    arm.skin_ports = folder  # folder of the ports of its skins, by their numbers
    return arm


def make_emulated_skin(setup: DeviceSetup) -> "ReSkin":
    """Make the driver of a real ReSkin board, reading an emulated board.

    Args:
        setup: The set-up, with the arm, and the port of a running board unless the arm's lab was started.

    Returns:
        The skin, not connected.
    """
    ports: Path | None = getattr(setup.arm, "skin_ports", None)
    return make_reskin(setup if ports is None else replace(setup, address=str(ports / str(_number_of(setup)))))


def _lab_of(arm: Any) -> Any:
    """Return the lab of a simulated arm; refuse other arms."""
    lab = getattr(arm, "lab", None)
    if lab is None:
        raise ValueError("a simulated skin needs a simulated arm; pass --arm simulated")
    return lab


def _number_of(setup: DeviceSetup) -> int:
    """Number a skin: 0 for the pressing one, then those of the rig."""
    name, further = setup.skin.name if setup.skin else "", [skin.name for skin in setup.rig.skins]
    return 1 + further.index(name) if name in further else 0


simulated_arm = DevicePlugin(make_simulated_arm, takes=frozenset(), make_clock=virtual_clock)
simulated_skin = DevicePlugin(
    make_simulated_skin, takes=frozenset({"board", "pad"}), arms=frozenset({"simulated"}), make_clock=virtual_clock
)
simulated_camera = DevicePlugin(make_simulated_camera, takes=frozenset(), make_clock=virtual_clock)
emulated_arm = DevicePlugin(make_emulated_arm, takes=ur.takes)
emulated_skin = DevicePlugin(
    make_emulated_skin,
    takes=(reskin.takes | {"pad"}) - {"skin_serial"},
    arms=frozenset({"emulated"}),
    address_follows_arm=True,
)
