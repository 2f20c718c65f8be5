"""An arm, a skin and a depth camera of a third party, for `python -m i2t.collect --arm acme --skin acme --camera acme`.

Acme's controller is played by i2t's simulated lab; a real package would talk to its own library in these places.
"""

from functools import lru_cache
from typing import SupportsIndex

import jax

from i2t.depth.camera import Camera
from i2t.emulators.in_process import QUEUE_SAMPLES, Row, SimulatedArm, SimulatedCamera, SimulatedLab
from i2t.emulators.scene import ObjectScene
from i2t.errors import DeviceTimeoutError, NotConnectedError
from i2t.hardware.base import DeviceBase
from i2t.hardware.clock import MonotonicClock
from i2t.hardware.plugins import DeviceSetup
from i2t.hardware.protocols import (
    ArmFeatures,
    CameraFeatures,
    Samples,
    SkinCounters,
    SkinFeatures,
    channel_names,
)
from i2t.hardware.rig import Rig
from i2t.objects.catalogue import make_object
from i2t.simulation.touches import SimulationErrors
from i2t.skin.boards import grid_board
from i2t.skin.pad import nominal_pad

BOARD = grid_board(2, 2)  # Acme's skin has four chips and so twelve values
RATE_HZ = 400.0


@lru_cache(1)
def connection(rig: Rig) -> SimulatedLab:
    """Acme's controller, which arm and skin share: a hexagon stands on its table where the rig says."""
    T_b_o = rig.T_base_world @ rig.T_world_object
    pad = jax.jit(lambda: nominal_pad(board=BOARD))()
    scene = ObjectScene(make_object("hexagon").mesh, T_b_o, pad, SimulationErrors())
    return SimulatedLab(scene, MonotonicClock())


class AcmeArm(SimulatedArm):
    """Acme's arm (`i2t.hardware.protocols.GuardedArm`), within the rig's limits."""

    def __init__(self, setup: DeviceSetup) -> None:
        super().__init__(connection(setup.rig), setup.rig.limits)

    @property
    def features(self) -> ArmFeatures:
        """Features known before `connect`; a real arm says that its source is real."""
        return super().features._replace(name="Acme's arm")


class AcmeSkin(DeviceBase):
    """Acme's skin (`i2t.hardware.protocols.Skin`), method by method; `board` says where its four chips are.

    It calls `lab` where a real package calls its own library, whose thread would fill the queue of samples.
    """

    board = BOARD

    def __init__(self, setup: DeviceSetup) -> None:
        self._lab, self._open, self._connects = connection(setup.rig), False, 0
        self._queue = self._lab.skins[0]

    @property
    def features(self) -> SkinFeatures:
        """Features known before `connect`."""
        return SkinFeatures("Acme's skin", "simulated", channel_names(BOARD.num_chips), "uT", RATE_HZ)

    @property
    def counters(self) -> SkinCounters:
        """Samples so far; a real skin counts lost ones here too."""
        rate = RATE_HZ if self._open else 0.0
        return SkinCounters(samples=self._queue.number, connects=self._connects, rate=rate)

    def connect(self) -> None:
        """Begin to send; earlier measurements are not sent."""
        self._lab.advance()
        self._queue.recording = self._open = True
        self._connects += 1
        self.read(1)

    def close(self) -> None:
        """Stop sending."""
        self._queue.recording = self._open = False

    def latest(self, timeout: float = 0.4) -> Samples:
        """The newest sample, which must not be older than the timeout (s)."""
        newest = self._queued()[-1:]
        if not newest or self._lab.clock.now() - newest[0][1] > timeout:
            raise DeviceTimeoutError(f"Acme's skin has been silent for more than {timeout:g} s; check its cable")
        return self._queue.rows(newest)

    def read(self, count: int, timeout: float | None = None) -> Samples:
        """The next samples, all measured after the call."""
        called, last = self._lab.clock.now(), self._queue.number - 1
        if not 0 < count <= QUEUE_SAMPLES:
            raise ValueError(f"{count} samples were asked for; the queue holds 1 to {QUEUE_SAMPLES}")
        until = called + (2 * count / RATE_HZ + 0.5 if timeout is None else timeout)
        while True:
            rows = [row for row in self._queued(last) if row[1] > called][:count]
            if len(rows) == count:
                return self._queue.rows(rows)
            if self._lab.clock.now() > until:
                raise DeviceTimeoutError(f"Acme's skin gave {len(rows)} of {count} samples in time; check its cable")
            self._lab.clock.sleep(1 / RATE_HZ)

    def since(self, number: SupportsIndex) -> Samples:
        """Samples after another that are still queued, without waiting."""
        return self._queue.rows(self._queued(int(number)))

    def _queued(self, after: int = -1) -> list[Row]:
        if not self._open:
            raise NotConnectedError("Acme's skin is not connected; call connect() or use with")
        with self._lab.lock:
            self._lab.advance()
            return [row for row in self._queue.samples if row[0] > after]


class AcmeCamera(SimulatedCamera):
    """Acme's camera (`i2t.hardware.protocols.DepthCamera`), which the arm carries."""

    def __init__(self, setup: DeviceSetup) -> None:
        lab, arm, lens = connection(setup.rig), setup.arm or AcmeArm(setup), setup.rig.camera
        pinhole = Camera(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
        super().__init__(lab.scene, pinhole, setup.rig.T_tool_camera, lambda: arm.state().T_b_t, lab.clock)

    @property
    def features(self) -> CameraFeatures:
        """Features known before `connect`."""
        return super().features._replace(name="Acme's camera")
