"""Skins of i2t meet the contract: the real driver with an emulated board, and the simulated one."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from helpers.spring_plane import SpringPlane

from i2t.emulators.in_process import SimulatedLab, SimulatedSkin
from i2t.emulators.reskin_board import run_board
from i2t.hardware.clock import MonotonicClock
from i2t.hardware.contract import SkinContract
from i2t.hardware.protocols import Skin
from i2t.hardware.reskin.driver import ReSkin
from i2t.simulation.touches import SimulationErrors
from i2t.skin import boards


class TestEmulatedSkin(SkinContract):
    @pytest.fixture
    def make(self) -> Iterator[Callable[[], Skin]]:
        with run_board() as (port, _):
            yield lambda: ReSkin(port)


class TestSimulatedSkin(SkinContract):
    @pytest.fixture(params=[boards.reskin_board(), boards.grid_board(2, 2)], ids=["5 chips", "4 chips"])
    def make(self, request) -> Callable[[], Skin]:
        board = request.param
        plane = SpringPlane(0.0, 1e4, np.zeros(board.num_readings), SimulationErrors(), board)
        lab = SimulatedLab(plane, MonotonicClock())
        return lambda: SimulatedSkin(lab)
