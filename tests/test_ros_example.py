"""The ROS 2 example with a substitute for rclpy: every sample is published with its time, a lost board reconnects."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from i2t.errors import DeviceError
from i2t.hardware.protocols import Samples

NODE = Path(__file__).parents[1] / "examples" / "ros2" / "skin_node.py"


def fake_time(seconds=0.0):
    return SimpleNamespace(nanoseconds=round(seconds * 1e9), to_msg=lambda: seconds)


class FakeNode:
    """The part of rclpy's Node that the example uses."""

    def __init__(self, name):
        self.timers, self.sent, self.said, self.clock_s = [], {}, [], 1000.0

    def declare_parameter(self, name, value):
        return SimpleNamespace(value=value)

    def create_publisher(self, kind, topic, depth):
        self.sent[topic] = []
        return SimpleNamespace(publish=self.sent[topic].append)

    def create_timer(self, period, call):
        self.timers.append(call)

    def get_clock(self):
        return SimpleNamespace(now=lambda: fake_time(self.clock_s))

    def get_logger(self):
        return SimpleNamespace(error=self.said.append)

    def destroy_node(self):
        pass


def magnetic_field():
    return SimpleNamespace(header=SimpleNamespace(stamp=None, frame_id=""), magnetic_field=SimpleNamespace())


class FakeSkin:
    """A skin that returns the samples of the test."""

    def __init__(self):
        self.rows, self.gone, self.connects, self.closed = [(0, 5.0, np.arange(15.0))], False, 0, False

    def connect(self):
        if self.gone:
            raise DeviceError("there is no port /dev/ttyACM0; plug the skin in or name its port")
        self.connects += 1

    def close(self):
        self.closed = True

    def latest(self):
        return self._samples(self.rows[-1:])

    def since(self, number):
        if self.gone:
            raise DeviceError("the skin is gone; plug it in and connect again")
        return self._samples([row for row in self.rows if row[0] > number])

    def _samples(self, rows):
        number, time, values = (np.array([row[i] for row in rows]) for i in range(3))
        return Samples(number, time, values.reshape(-1, 15), np.full((len(rows), 5), np.nan))


@pytest.fixture
def example(monkeypatch):
    modules = {
        name: ModuleType(name) for name in ("rclpy", "rclpy.node", "rclpy.time", "sensor_msgs", "sensor_msgs.msg")
    }
    modules["rclpy.node"].Node, modules["rclpy.time"].Time = FakeNode, fake_time
    modules["sensor_msgs.msg"].MagneticField = magnetic_field
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("skin_node", NODE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_sample_is_published_once_in_tesla_with_its_time(example):
    skin = FakeSkin()
    node = example.SkinNode(skin)
    assert list(node.sent) == [f"skin/chip{i}" for i in range(5)]
    missing = np.arange(15.0) + 1
    missing[3:6] = np.nan
    skin.rows += [(1, 5.01, np.arange(15.0)), (2, 5.02, missing)]
    (publish,) = node.timers
    publish()
    publish()
    first, second = node.sent["skin/chip1"]
    assert (first.magnetic_field.x, first.magnetic_field.z) == (pytest.approx(3e-6), pytest.approx(5e-6))
    assert np.isnan(second.magnetic_field.y)
    assert first.header.frame_id == "skin_chip1"
    assert second.header.stamp - first.header.stamp == pytest.approx(0.01)
    assert first.header.stamp == pytest.approx(1000.01)
    node.destroy_node()
    assert skin.closed


@pytest.mark.parametrize("from_the_beginning", [False, True])
def test_a_lost_board_is_reported_and_searched_for_again(example, from_the_beginning):
    skin = FakeSkin()
    skin.gone = from_the_beginning
    node = example.SkinNode(skin)
    skin.gone = True
    node.publish()
    assert ("there is no port" if from_the_beginning else "plug it in") in node.said[0]
    node.publish()
    assert len(node.said) == 1  # not a hundred times a second
    skin.gone, node.clock_s = False, node.clock_s + 2
    skin.rows.append((1, 6.0, np.ones(15)))
    node.publish()
    assert skin.connects == 2 - from_the_beginning
    skin.rows.append((2, 6.01, np.ones(15)))
    node.publish()
    assert node.sent["skin/chip0"][-1].magnetic_field.x == pytest.approx(1e-6)
