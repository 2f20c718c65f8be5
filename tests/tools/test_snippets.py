"""`tools.snippets` runs the snippets of a page as one notebook, and compares or renews their outputs."""

import pytest

from tools import snippets
from tools.check_docs import pages

PAGE = """# Page

```python
import os

a = 1.2345
print(a, "uT")
```

```output
1.2400 uT
```

Text, and a command, which writes a file:

<!-- a note -->
```
python -c "print(open('examples/data/mug.stl', 'rb').read(5))" > note
cat note && echo 12 touches in 3.1 s && pwd
```

```output
b'wrong' and so on
```

<!-- not run: it needs a robot -->
```
false
```

<!-- slow: an hour -->
```python
raise SystemError
```

```python
print(open("note").read().strip())
{"a": a}
```

```text
no snippet
```
"""


def line_of(words: str) -> int:
    """Line of the page on which some words begin."""
    return PAGE[: PAGE.index(words)].count("\n") + 1


@pytest.fixture(scope="module")
def outputs():
    return snippets.outputs_of(PAGE)


def test_snippets_share_names_and_files_and_show_the_last_value(outputs):
    first, second, robot, slow, last = outputs
    assert first == "1.2345 uT\n"
    assert second.startswith("b'")
    assert "12 touches in 3.1 s" in second
    assert robot is slow is None
    assert last == second.splitlines()[0] + "\n{'a': 1.2345}\n"


def test_a_wrong_output_is_reported_with_its_line_and_both_texts(outputs, monkeypatch, tmp_path, capsys):
    right, wrong = snippets.differences(PAGE, outputs)
    assert right.line == line_of("```\npython -c")
    for words in ("the page shows\nb'wrong' and so on\n", "but the snippet prints\nb'", "12 touches"):
        assert words in right.sentence
    assert wrong.sentence.startswith("the page shows\nbut the snippet prints\nb'")  # there is no output yet
    page = tmp_path / "page.md"
    page.write_text(PAGE)
    monkeypatch.setattr(snippets, "ROOT", tmp_path)
    monkeypatch.setattr(snippets, "pages_of", lambda root: {"page": page})
    monkeypatch.setattr(snippets, "outputs_of", lambda text, slow: outputs)
    assert snippets.main([]) == 1
    assert f"page.md:{right.line}: {right.sentence}\n" in capsys.readouterr().out
    assert snippets.main(["--write"]) == 0
    assert snippets.main([]) == 0


def test_renewed_pages_agree_and_do_not_change_again(outputs):
    page = snippets.renewed(PAGE, outputs)
    assert not list(snippets.differences(page, outputs))
    assert snippets.renewed(page, outputs) == page
    assert "```output\n1.2400 uT\n```" in page  # within the tolerance
    assert "wrong" not in page
    assert f'{{"a": a}}\n```\n\n```output\n{outputs[-1]}```\n\n```text\n' in page
    silent = [output and "" for output in outputs]
    assert "```output" not in snippets.renewed(page, silent)
    again = snippets.renewed(snippets.renewed(page, silent), outputs)
    assert again.replace("```output\n1.2345", "```output\n1.2400") == page


def test_a_snippet_that_fails_is_reported_with_its_line_and_error():
    with pytest.raises(snippets.SnippetError) as failed:
        snippets.outputs_of("Text\n\n```python\nx = 1\n```\n\n```python\nprint(y)\n```\n\n```python\nx\n```\n")
    assert failed.value.args == (7, "the snippet fails with NameError: name 'y' is not defined")


@pytest.mark.full
def test_a_command_that_fails_is_reported_with_its_own_words():
    with pytest.raises(snippets.SnippetError) as failed:
        snippets.outputs_of("```\npython -m i2t.nothing\necho not reached\n```\n")
    line, sentence = failed.value.args
    assert line == 1
    assert "CalledProcessError" in sentence
    assert "No module named i2t.nothing" in sentence


@pytest.mark.parametrize(
    ("stored", "printed", "same"),
    [
        ("R2 0.824", "R2 0.830", True),  # 1 %
        ("R2 0.824", "R2 0.840", False),
        ("R2 .05", "R2 .06", True),  # one unit of the last digit
        ("R2 .05", "R2 .07", False),
        ("[ 0.1  -0.0]", "[0.1 0.]", True),
        ("[-0.3]", "[0.3]", False),
        ("1.00e-3 m", "1.005e-3 m", True),
        ("1.00e-3 m", "1.05e-3 m", False),
        ("100 touches", "101 touches", False),
        ("hammer 85 %", "hammer 86 %", True),
        ("hammer 85 %", "hammer 87 %", False),
        ("done in 3.1 s", "done in 41.2 s", True),
        ("3.1 N", "4.1 N", False),
        ("a\n  b", "a b\n", True),
        ("hammer 0.3", "star 0.3", False),
        ("0.3 0.3", "0.3", False),
    ],
)
def test_numbers_agree_within_a_tolerance_and_words_exactly(stored, printed, same):
    assert snippets.agree(stored, printed) is same


def test_a_snippet_without_output_is_found_by_check_docs():
    page = pages.ROOT / "docs" / "start.md"
    lines = [problem.line for problem in pages.outputs(page, PAGE)]
    assert lines == [
        PAGE[: PAGE.index(marked)].count("\n") + 1 for marked in ("```python\nraise", "```python\nprint(o")
    ]
    assert not list(pages.outputs(pages.ROOT / "docs" / "data.md", PAGE))


@pytest.mark.full
@pytest.mark.parametrize("name", snippets.pages_of(snippets.ROOT))
def test_the_outputs_of_a_page_are_those_of_its_snippets(name):
    text = snippets.pages_of(snippets.ROOT)[name].read_text()
    assert list(snippets.differences(text, snippets.outputs_of(text))) == []
