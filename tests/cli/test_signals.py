"""Signals that end a command: each has its exit code, and none is lost, wherever it arrives."""

import contextlib
import gc
import importlib
import signal
import sys
import threading
import time
import weakref

import pytest

from i2t.cli import exit_codes
from i2t.cli.exit_codes import exit_code_of
from i2t.cli.signals import ENDING_SIGNALS, SignalInterrupt, ended_by_ctrl_c
from i2t.errors import DeviceError


@pytest.fixture(params=ENDING_SIGNALS, ids=lambda number: number.name)
def number(request):
    """The number of a signal that has its default handler."""
    default = signal.default_int_handler if request.param == signal.SIGINT else signal.SIG_DFL
    before = signal.signal(request.param, default)  # processes in the background of a script ignore SIGINT
    yield request.param
    restored = signal.signal(request.param, before)
    assert restored is default


def wait() -> None:
    """Wait for a signal that is sent again."""
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline:
        time.sleep(0.01)


def test_each_signal_has_its_exit_code_and_lets_the_work_end_in_order(number, capsys):
    ended = []

    def work():
        try:
            signal.raise_signal(number)
        except Exception:  # as libraries do
            ended.append("swallowed")
        finally:
            ended.append("in order")

    assert exit_code_of(work, "stopped; go on with --resume") == 128 + number
    assert capsys.readouterr().err == "\nstopped; go on with --resume\n"
    assert ended == ["in order"]


def test_a_signal_lets_a_module_be_imported_first(number, tmp_path, monkeypatch):
    """A compiled module that is interrupted during its import may crash the process."""
    (tmp_path / "slow_to_start.py").write_text(f"import signal\nsignal.raise_signal({number:d})\nstarted = True\n")
    monkeypatch.syspath_prepend(str(tmp_path))

    def work():
        importlib.import_module("slow_to_start")
        wait()

    assert exit_code_of(work) == 128 + number
    assert sys.modules.pop("slow_to_start").started


class Cycle:
    """An object that only the garbage collector deletes."""

    def __init__(self, number):
        self.itself, self.number = self, number

    def __del__(self):
        signal.raise_signal(self.number)


def lose_in_weakref(number):
    thing = type("Thing", (), {})()
    kept = weakref.ref(thing, lambda _: signal.raise_signal(number))
    del thing
    return kept


def lose_in_gc_callback(number):
    def callback(*_):
        gc.callbacks.remove(callback)
        signal.raise_signal(number)

    gc.callbacks.append(callback)
    gc.collect()


def lose_in_deletion(number):
    Cycle(number)
    gc.collect()


def lose_in_library(number):
    with contextlib.suppress(BaseException):
        signal.raise_signal(number)


@pytest.mark.parametrize("lose", [lose_in_weakref, lose_in_gc_callback, lose_in_deletion, lose_in_library])
def test_a_signal_whose_exception_is_lost_is_sent_again(number, lose, capsys):
    def work():
        lose(number)
        wait()

    assert exit_code_of(work) == 128 + number
    assert capsys.readouterr().err == "\ninterrupted\n"  # no "Exception ignored in"


def test_an_error_that_replaces_the_exception_of_a_signal_is_an_interruption(number, capsys):
    """JAX's comparison of pytrees does so, and what tidies up meanwhile is not interrupted."""
    tidied = []

    def work():
        lose_in_library(number)
        try:
            raise ValueError("Exception raised while checking equality")
        finally:
            time.sleep(0.2)
            tidied.append(True)

    assert exit_code_of(work) == 128 + number
    assert "equality" not in capsys.readouterr().err
    assert tidied


def test_an_error_while_a_signal_is_handled_is_reported(number, capsys):
    def work():
        try:
            signal.raise_signal(number)
        finally:
            raise DeviceError("the arm does not stop; press the emergency stop")

    assert exit_code_of(work) == 1
    assert capsys.readouterr().err == "error: the arm does not stop; press the emergency stop\n"


def test_ctrl_c_may_end_a_part_of_the_work_and_other_signals_end_all(number):
    def work():
        with ended_by_ctrl_c():
            signal.raise_signal(number)
        time.sleep(0.2)  # in which a lost signal would be sent again

    assert exit_code_of(work) == (0 if number == signal.SIGINT else 128 + number)


def test_a_signal_that_the_program_ignores_stays_ignored(number):
    default = signal.signal(number, signal.SIG_IGN)
    try:
        assert exit_code_of(lambda: signal.raise_signal(number)) == 0
    finally:
        signal.signal(number, default)


def test_a_nested_command_and_one_in_a_thread_leave_the_handlers_as_they_are(number):
    def nested():
        assert exit_code_of(lambda: 0) == 0
        thread = threading.Thread(target=exit_code_of, args=(lambda: 0,))
        thread.start()
        thread.join()
        with pytest.raises(SignalInterrupt):
            signal.raise_signal(number)

    assert exit_code_of(nested) == 0


def test_a_signal_while_the_command_line_is_read_ends_the_command(number, monkeypatch, capsys):
    monkeypatch.setattr(exit_codes, "read_options", lambda *_, **__: signal.raise_signal(number))
    main = exit_codes.command(dict, lambda _: 0, program="i2t", interrupted=lambda options: f"stopped: {options}")
    assert main([]) == 128 + number
    assert capsys.readouterr().err == "\ninterrupted\n"
