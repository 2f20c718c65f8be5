"""Library modules log, and only commands print."""

import ast
import logging
from pathlib import Path

from i2t.cli.exit_codes import exit_code_of

LIBRARY = Path(__file__).parents[2] / "i2t"
COMMANDS = {  # modules of commands, and what the command alone uses
    "cli/commands.py",
    "cli/exit_codes.py",
    "collect/checks.py",
    "collect/dry_run.py",
    "collect/session.py",
    "collect/start.py",
    "commands/fit.py",
    "commands/recognize.py",
    "convert/commands.py",
    "emulators/reskin_board.py",
    "emulators/ur_controller.py",
    "hardware/hand_eye.py",
    "hardware/realsense.py",
    "hardware/reskin/monitor.py",
    "hardware/rig/__main__.py",
    "hardware/touch_off.py",
    "imagine.py",
    "place.py",
    "view/command.py",
}


def _prints(path: Path) -> bool:
    calls = (node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call))
    return any(isinstance(called, ast.Name) and called.id == "print" for called in calls)


def test_only_commands_print():
    assert {str(path.relative_to(LIBRARY)) for path in LIBRARY.rglob("*.py") if _prints(path)} == COMMANDS


def test_a_command_shows_what_the_library_logs_in_plain_lines_once(capsys, monkeypatch):
    log, root = logging.getLogger("i2t.some.module"), logging.getLogger()
    monkeypatch.setattr(root, "handlers", [])  # pytest's

    def work() -> int:
        root.addHandler(logging.StreamHandler())  # as absl does when orbax is imported
        log.debug("hidden")
        log.info("shown")
        return exit_code_of(lambda: log.warning("shown once"))

    assert exit_code_of(work) == 0
    log.info("hidden too")
    assert capsys.readouterr() == ("", "shown\nshown once\n")
    assert logging.getLogger("i2t").handlers == []


def test_a_command_leaves_logging_that_the_program_has_configured_as_it_is(capsys, monkeypatch):
    """A record is shown once, by the program's handler, from the program's level on."""
    log = logging.getLogger("i2t")
    monkeypatch.setattr(logging.getLogger(), "handlers", [logging.StreamHandler()])
    monkeypatch.setattr(log, "level", logging.WARNING)

    def work() -> None:
        log.info("hidden")
        log.warning("shown")

    assert exit_code_of(work) == 0
    assert capsys.readouterr() == ("", "shown\n")
    assert (log.handlers, log.level, log.propagate) == ([], logging.WARNING, True)
