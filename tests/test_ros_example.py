"""The ROS 2 example under a stand-in for rclpy: every sample is published with its time, a gone board comes back."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from i2t.errors import DeviceError
from i2t.hardware.protocols import Samples

NODE = Path(__file__).parents[1] / "examples" / "ros2" / "skin_node.py"


class FakeTime:
    def __init__(self, seconds=0.0):
        self.seconds = seconds
        self.nanoseconds = round(seconds * 1e9)

    def to_msg(self):
        return self.seconds


class FakePublisher:
    def __init__(self, topic):
        self.topic, self.sent = topic, []

    def publish(self, message):
        self.sent.append(message)


class FakeNode:
    """What of rclpy's Node the example uses."""

    def __init__(self, name):
        self.name, self.timers, self.publishers, self.said, self.clock_s = name, [], [], [], 1000.0

    def declare_parameter(self, name, value):
        return SimpleNamespace(value=value)

    def create_publisher(self, kind, topic, depth):
        self.publishers.append(FakePublisher(topic))
        return self.publishers[-1]

    def create_timer(self, period, call):
        self.timers.append((period, call))

    def get_clock(self):
        return SimpleNamespace(now=lambda: FakeTime(self.clock_s))

    def get_logger(self):
        return SimpleNamespace(error=self.said.append)

    def destroy_node(self):
        pass


def magnetic_field():
    return SimpleNamespace(header=SimpleNamespace(stamp=None, frame_id=""), magnetic_field=SimpleNamespace())


class FakeSkin:
    """Gives samples that a test puts in."""

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
        return Samples(
            np.array([row[0] for row in rows]), np.array([row[1] for row in rows]),
            np.array([row[2] for row in rows]).reshape(-1, 15), np.full((len(rows), 5), np.nan),
        )  # fmt: skip


@pytest.fixture
def example(monkeypatch):
    modules = {
        name: ModuleType(name) for name in ("rclpy", "rclpy.node", "rclpy.time", "sensor_msgs", "sensor_msgs.msg")
    }
    modules["rclpy.node"].Node, modules["rclpy.time"].Time = FakeNode, FakeTime
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
    assert [each.topic for each in node.publishers] == [f"skin/chip{i}" for i in range(5)]
    missing = np.arange(15.0) + 1
    missing[3:6] = np.nan
    skin.rows += [(1, 5.01, np.arange(15.0)), (2, 5.02, missing)]
    ((_, publish),) = node.timers
    publish()
    publish()
    first, second = node.publishers[1].sent
    assert (first.magnetic_field.x, first.magnetic_field.z) == (pytest.approx(3e-6), pytest.approx(5e-6))
    assert np.isnan(second.magnetic_field.y)
    assert first.header.frame_id == "skin_chip1"
    assert second.header.stamp - first.header.stamp == pytest.approx(0.01)
    assert first.header.stamp == pytest.approx(1000.01)
    node.destroy_node()
    assert skin.closed


def test_a_board_that_is_gone_is_said_and_looked_for_again(example):
    skin = FakeSkin()
    node = example.SkinNode(skin)
    skin.gone = True
    node.publish()
    assert "plug it in" in node.said[-1]
    node.publish()
    assert len(node.said) == 1  # not a hundred times a second
    skin.gone, node.clock_s = False, node.clock_s + 2
    skin.rows.append((1, 6.0, np.ones(15)))
    node.publish()
    skin.rows.append((2, 6.01, np.ones(15)))
    node.publish()
    assert skin.connects == 2
    assert node.publishers[0].sent[-1].magnetic_field.x == pytest.approx(1e-6)


def test_a_node_without_a_board_waits_for_one(example):
    skin = FakeSkin()
    skin.gone = True
    node = example.SkinNode(skin)
    assert "there is no port" in node.said[0]
    skin.gone, node.clock_s = False, node.clock_s + 2
    node.publish()
    assert skin.connects == 1
