"""Mutants are changes of single places, and are killed or survive as their tests say."""

import json
import textwrap
from collections import Counter
from pathlib import Path

import pytest

from experiments import mutants
from experiments.mutants import mutants_of

SOURCE = '''
"""Docstring with 1 < 2 and not a word of it changed."""
import math
LIMIT: float = 3.5


@decorated(size=4)
def clip(x: Float[Array, "3 4"], low=0, *, loud=True):
    """Not changed: 5 + 6."""
    if x < low and not loud:
        raise ValueError(f"{x + 1} is less than {low}")
    x += 1
    state.count = -x
    log(x)
    return min(x, LIMIT) * 2
'''


def changed(found) -> set[tuple[str, str, str]]:
    return {(mutant.operator, mutant.before, mutant.after) for mutant in found}


def test_every_operator_changes_what_does_something_and_nothing_else():
    found = mutants_of(SOURCE)
    assert changed(found) == {
        ("constant", "3.5", "7.0"), ("constant", "0", "1"), ("constant", "True", "False"), ("constant", "1", "2"),
        ("constant", "2", "3"), ("comparison", "<", "<="), ("comparison", "<", ">"), ("boolean", "and", "or"),
        ("sign or negation dropped", "not loud", "(loud)"), ("sign or negation dropped", "-x", "(x)"),
        ("condition negated", "x < low and not loud", "(not (x < low and not loud))"),
        ("statement removed", 'raise ValueError(f"{x + 1} is less than {low}")', "pass"),
        ("statement removed", "x += 1", "pass"), ("statement removed", "state.count = -x", "pass"),
        ("statement removed", "log(x)", "pass"), ("arithmetic", "+=", "-="), ("arithmetic", "*", "/"),
        ("call", "min", "max"),
    }  # fmt: skip
    assert len(found) == len(set(found))
    assert all(mutants.can_be_parsed(mutant.apply(SOURCE.encode())) for mutant in found)
    assert not mutants.can_be_parsed(b"x = (")


def test_a_mutant_differs_in_its_place_only():
    """Places are bytes: letters of several before it do not shift them."""
    source = 'name = "µT°"; far = name if 1 <= 2 else 3\n'
    for mutant in mutants_of(source):
        assert mutant.apply(source.encode()).decode().replace(mutant.after, mutant.before, 1) == source
        assert mutant.apply(source.encode()) != source.encode()
    turned = [mutant for mutant in mutants_of(source) if mutant.after == ">="]
    assert [mutant.apply(source.encode()).decode() for mutant in turned] == [source.replace("<=", ">=")]


@pytest.mark.parametrize(
    ("line", "after"),
    [
        ("a = jnp.where(b > 0, c, d)", "a = jnp.where(~(b > 0), c, d)"),
        ("a = b @ c ** 2", "a = b @ c * 2"),
        ("a = b if c else d", "a = b if (not (c)) else d"),
        ("a = b is not None", "a = b is None"),
        ("a = x.sum()", "a = x.mean()"),
        ("while a: break", "while a: pass"),
    ],
)
def test_single_changes(line, after):
    assert after in [mutant.apply(line.encode()).decode() for mutant in mutants_of(line)]


def test_all_modules_and_their_tests_exist():
    for module, tests in mutants.TESTS.items():
        assert all((mutants.ROOT / path).is_file() for path in (module, *tests))
        assert len(mutants_of((mutants.ROOT / module).read_text())) > 1


def test_a_sample_is_that_of_its_seed():
    args = mutants.MutantArgs(count=5, seed=3)
    module = "i2t/recognition/ensemble.py"
    tests, some = mutants.draw(module, args)
    assert tests == mutants.TESTS[module]
    assert some == mutants.draw(module, args)[1]
    assert some != mutants.draw(module, mutants.MutantArgs(count=5, seed=4))[1]
    assert len(set(some)) == 5
    with pytest.raises(ValueError, match="name them with --tests"):
        mutants.draw("i2t/errors.py", args)
    with pytest.raises(ValueError, match="is no file"):
        mutants.draw("i2t/nothing.py", args)


def test_rates_and_the_report_name_the_survivors():
    row = {"module": "a.py", "line": 3, "before": "<", "after": "<="}
    tried = [row | {"result": result} for result in ("killed", "timeout", "survived", "killed")]
    result = mutants.summarise(tried)
    assert result["all"] == result["modules"]["a.py"] == {"tried": 4, "killed": 3, "survived": 1, "rate": 0.75}
    text = mutants.format_report(tried, result)
    assert "survived: a.py:3: < -> <=" in text
    assert text.count("a.py:3") == 1


@pytest.fixture
def project(tmp_path, monkeypatch) -> Path:
    """A checkout with one small module, half of which is tested."""
    root = tmp_path / "checkout"
    files = {
        "i2t/__init__.py": "",
        "i2t/core.py": """
            def spent(x):
                while x:
                    x -= 1
                return x

            def untested(x):
                return x + y
            """,
        "tests/test_core.py": """
            from i2t.core import spent

            def test_nothing_is_left():
                assert spent(3) == 0
            """,
        "pyproject.toml": "",
    }
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(textwrap.dedent(text))
    monkeypatch.setattr(mutants, "ROOT", root)
    monkeypatch.setattr(mutants, "LEAST_TIME_S", 5.0)
    return root


@pytest.mark.full
def test_tests_kill_mutants_or_let_them_live(project, tmp_path, capsys):
    before = (project / "i2t/core.py").read_bytes()
    command = [
        "--modules",
        "i2t/core.py",
        "--tests",
        "tests/test_core.py",
        "--count",
        "0",
        "--out",
        str(tmp_path / "out"),
    ]
    assert mutants.main([*command, "--timeout", "60"]) == 0
    tried = json.loads((tmp_path / "out/mutants.json").read_text())["tried"]
    results = {(row["before"], row["after"]): row["result"] for row in tried}
    assert results["+", "-"] == "survived"  # nobody looks at `untested`
    assert results["x", "(not (x))"] == "killed"
    assert results["-=", "+="] == results["x -= 1", "pass"] == results["1", "2"] == "timeout"
    counts = Counter(row["result"] for row in tried)
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert metrics["all"]["tried"] == len(tried) == counts.total()
    assert "survived: i2t/core.py:8: + -> -" in capsys.readouterr().out
    assert (project / "i2t/core.py").read_bytes() == before
    assert mutants.main(command) == 2  # a finished run is not overwritten


@pytest.mark.full
def test_an_unfinished_sample_goes_on(project, tmp_path):
    out = tmp_path / "out"
    command = ["--modules", "i2t/core.py", "--tests", "tests/test_core.py", "--count", "4", "--out", str(out)]
    assert mutants.main([*command, "--timeout", "60"]) == 0
    (out / "metrics.json").unlink()
    tried = json.loads((out / "mutants.json").read_text())["tried"]
    first = tried[0] | {"result": "kept"}
    (out / "mutants.json").write_text(json.dumps({"tried": [first]}))
    assert mutants.main([*command, "--timeout", "60", "--resume"]) == 0
    again = json.loads((out / "mutants.json").read_text())["tried"]
    assert again[0] == first
    assert [row["after"] for row in again] == [row["after"] for row in tried]


@pytest.mark.full
def test_tests_that_fail_anyway_are_refused(project, tmp_path, capsys):
    (project / "tests/test_core.py").write_text("def test_no():\n    assert False\n")
    command = ["--modules", "i2t/core.py", "--tests", "tests/test_core.py", "--out", str(tmp_path / "out")]
    assert mutants.main(command) == 2
    assert "make them pass first" in capsys.readouterr().err
