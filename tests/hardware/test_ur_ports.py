"""Messages about a UR controller whose ports do not all answer."""

import contextlib
import itertools
import socket
import struct
import sys
import threading

import pytest

from i2t.emulators.ur_controller import loopback
from i2t.errors import DeviceError
from i2t.hardware.ur import access, ports
from i2t.hardware.ur.ports import DASHBOARD, PORTS, RTDE, SCRIPT, Answer, explain

numbers = itertools.count(100)
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs the addresses 127.x.y.z, which only Linux gives")


class FakeController:
    """Ports of an address of this machine, each of which behaves in one way.

    Args:
        version: Major version of URControl that RTDE tells; 0 tells none.
        states: Answers of the dashboard by question.
    """

    def __init__(self, version: int = 5, **states: str) -> None:
        self.host, self.version = loopback(next(numbers)), version
        self.states = {"is in remote control": "true", "safetystatus": "Safetystatus: NORMAL"} | {
            "running": "Program running: false"
        } | {question.replace("_", " "): answer for question, answer in states.items()}  # fmt: skip
        self.stack = contextlib.ExitStack()

    def __enter__(self) -> "FakeController":
        return self

    def __exit__(self, *error: object) -> None:
        self.stack.close()

    def listen(self, *opened: ports.Port, answer: Answer = Answer.ANSWERS) -> "FakeController":
        for port in opened:
            server = self.stack.enter_context(socket.create_server((self.host, port.number)))
            if answer is Answer.TIMED_OUT:  # a full queue: the kernel drops what comes
                server.listen(0)
                self.stack.enter_context(socket.create_connection((self.host, port.number)))
                continue
            threading.Thread(target=self._serve, args=(server, port, answer), daemon=True).start()
            self.stack.callback(server.shutdown, socket.SHUT_RDWR)
        return self

    def _serve(self, server: socket.socket, port: ports.Port, answer: Answer) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = server.accept()
                threading.Thread(target=self._talk, args=(client, port, answer), daemon=True).start()

    def _talk(self, client: socket.socket, port: ports.Port, answer: Answer) -> None:
        with contextlib.suppress(OSError), client:
            if answer is Answer.CLOSED:
                return
            if answer is Answer.ANSWERS and port == DASHBOARD:
                client.sendall(b"Connected: Universal Robots Dashboard Server\n")
                while line := client.recv(100).decode().strip():
                    client.sendall(self.states[line].encode() + b"\n")
            while data := client.recv(100):
                if answer is Answer.ANSWERS and data.startswith(ports.PROTOCOL_REQUEST):
                    client.sendall(b"\x00\x04V\x01")
                elif answer is Answer.ANSWERS and data == ports.VERSION_REQUEST and self.version:
                    client.sendall(struct.pack(">HB4I", 19, ord("v"), self.version, 11, 0, 7))


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(ports.probe, "__defaults__", (0.3,))
    monkeypatch.setattr(ports.controller_version, "__defaults__", (0.3,))


def refusal(host: str) -> str:
    with pytest.raises(DeviceError) as caught:
        access.check_controller(host)
    sentence = str(caught.value)
    assert sentence.endswith(".")
    assert ". " not in sentence
    return sentence


def test_a_controller_whose_ports_all_answer_is_accepted():
    with FakeController().listen(*PORTS) as fake:
        access.check_controller(fake.host)
        assert ports.controller_version(fake.host) == (5, 11, 0, 7)
        assert ports.explain_no_answer(fake.host) == ""


def test_polyscope_x_is_recognised_by_the_version_from_rtde():
    with FakeController(version=10).listen(RTDE, SCRIPT) as fake:
        sentence = refusal(fake.host)
        assert "answers on ports 30004 (RTDE) and 30003 (real-time client)" in sentence
        assert "refuses connections on port 29999 (dashboard)" in sentence
        assert "runs PolyScope X (URControl 10.11)" in sentence
        assert "enable" not in sentence
        access.check_reachable(fake.host)  # its pose can be asked for
    sentence = explain("10.0.0.1", dict.fromkeys(PORTS, Answer.TIMED_OUT) | {RTDE: Answer.ANSWERS}, (10, 7))
    assert "runs PolyScope X" in sentence
    assert "allow port" not in sentence  # nothing that would not help


def test_the_remedy_for_a_disabled_dashboard_is_to_enable_it():
    with FakeController(version=5).listen(RTDE, SCRIPT) as fake:
        sentence = refusal(fake.host)
        assert "enable Dashboard Server under Settings > Security > Services" in sentence
        assert "PolyScope X" not in sentence
    with FakeController(version=0).listen(RTDE, SCRIPT) as fake:
        assert "unless it runs PolyScope X" in refusal(fake.host)


@pytest.mark.parametrize("port", [RTDE, SCRIPT])
def test_a_service_that_is_switched_off_is_named(port):
    others = [other for other in PORTS if other != port]
    with FakeController().listen(*others) as fake:
        sentence = refusal(fake.host)
        assert f"answers on ports {others[0]} and {others[1]}, but refuses connections on port {port}" in sentence
        assert f"enable {port.service} under" in sentence


def test_the_remedy_for_a_port_behind_a_firewall_is_to_allow_it():
    with FakeController().listen(DASHBOARD, SCRIPT).listen(RTDE, answer=Answer.TIMED_OUT) as fake:
        assert "gives no sign on port 30004 (RTDE): allow port 30004" in refusal(fake.host)


def test_refused_ports_mean_another_machine_and_silence_means_no_machine():
    with FakeController() as fake:
        sentence = refusal(fake.host)
        assert "a machine is there, and refuses connections on ports 30004 (RTDE), 29999 (dashboard)" in sentence
    with FakeController().listen(*PORTS, answer=Answer.TIMED_OUT) as fake:
        assert "no reply comes from that address" in refusal(fake.host)
    with FakeController().listen(*PORTS, answer=Answer.CLOSED) as fake:
        assert "answers on port 30003" in refusal(fake.host)
    assert "no route to that address" in explain("10.0.0.1", dict.fromkeys(PORTS, Answer.NO_ROUTE))
    assert "is not known to this computer" in refusal("no-such-arm.invalid")
    assert "is not known to this computer" in refusal("http://192.168.0.2:29999")


def test_the_remedy_for_silent_open_ports_is_to_wait():
    with FakeController().listen(DASHBOARD, SCRIPT).listen(RTDE, answer=Answer.MUTE) as fake:
        assert "accepts connections and does not answer on port 30004 (RTDE): wait until" in refusal(fake.host)


@pytest.mark.parametrize(
    ("question", "answer", "words"),
    [
        ("is_in_remote_control", "false", "enabled under Settings > System > Remote Control"),
        ("safetystatus", "Safetystatus: PROTECTIVE_STOP", "in a protective stop"),
        ("safetystatus", "Safetystatus: ROBOT_EMERGENCY_STOP", "stopped for safety (ROBOT_EMERGENCY_STOP)"),
        ("running", "Program running: true", "A program runs"),
    ],
)
def test_the_reason_is_given_if_a_controller_answers_but_cannot_be_controlled(question, answer, words):
    with FakeController(**{question: answer}).listen(*PORTS) as fake:
        assert words in refusal(fake.host)


def test_a_dashboard_that_lacks_a_command_is_accepted():
    unknown = dict.fromkeys(("is_in_remote_control", "safetystatus"), "could not understand")
    with FakeController(version=3, **unknown).listen(*PORTS) as fake:
        access.check_controller(fake.host)
