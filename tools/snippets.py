"""Run the snippets of the README, the start page and the tutorials, and compare or renew the output below each.

    python -m tools.snippets                    compare; exit code 1 if an output differs
    python -m tools.snippets README --write     renew the outputs of one page
    python -m tools.snippets --all --write      renew all outputs, including those of slow snippets

A snippet is a block of Python, or of commands (language `bash`, or none). Its output is the block of the language
`output` below it. The snippets of a page run in order as cells of one notebook, in a temporary folder with a copy of
examples/. Standard output and the value of the last expression are shown, without the
timestamps in names of files; progress and notes on standard error are not.

A comment directly above a snippet exempts it: `<!-- not run: REASON -->` always, and `<!-- slow: DURATION -->` unless
--all is given. Until then, the stored output of a slow snippet is that of the last run with --all --write.

Two outputs agree if their words and whole numbers are equal, and other numbers and percentages differ by at most 1 % or
one unit of the last printed digit. Spaces, line breaks and durations are not compared.
"""

import math
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import tyro

from experiments.common.commands import command
from i2t.errors import did_you_mean

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^(?P<marks>(?:<!--[^\n]*-->\n)*)```(?P<language>[^`\n]*)\n(?P<text>.*?)^```\n", re.M | re.S)
OUTPUT = re.compile(r"\n*```output\n(.*?)^```\n", re.M | re.S)
NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)(?=( ?%)|( ?(?:ms|s|min|minutes?|seconds?)\b)|)")
TIMESTAMP = re.compile(r"\b\d{8}T\d{6}[.\d]*Z(?:-[0-9a-f]+)?")  # in names of files
RELATIVE_TOLERANCE = 1e-2
TIMEOUT_S = 600  # for each snippet that is not marked as slow


@dataclass(frozen=True)
class SnippetsArgs:
    """Run the snippets of pages, and compare or renew their outputs."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()  # names of pages, such as README; default: all
    write: bool = False  # renew the outputs instead of comparing them
    all: bool = False  # run slow snippets too


class Snippet(NamedTuple):
    """A snippet of a page and the output below it."""

    start: int  # position of its block in the text of the page
    end: int  # position behind its block and output
    language: str  # python, or bash for commands
    code: str
    marks: str  # comments directly above it
    output: str | None  # None if there is no output below it

    def runs(self, *, slow: bool) -> bool:
        """Whether it runs, with or without the slow ones."""
        return "<!-- not run:" not in self.marks and (slow or "<!-- slow:" not in self.marks)


class Difference(NamedTuple):
    """A snippet that fails or whose output differs."""

    line: int
    sentence: str


class SnippetError(Exception):
    """A snippet failed. The arguments are the line of the page and a sentence."""


def pages_of(root: Path) -> dict[str, Path]:
    """Pages whose snippets are run, by name."""
    pages = [root / "README.md", root / "docs" / "start.md", *sorted((root / "docs").glob("tutorial_*.md"))]
    return {page.stem: page for page in pages}


def snippets_of(text: str) -> list[Snippet]:
    """Find the snippets of a page and their outputs."""
    snippets = []
    for block in BLOCK.finditer(text):
        if block["language"] in ("python", "bash", ""):
            output = OUTPUT.match(text, block.end())
            snippets.append(
                Snippet(
                    block.end("marks"), output.end() if output else block.end(), block["language"] or "bash",
                    block["text"], block["marks"], output[1] if output else None,
                )
            )  # fmt: skip
    return snippets


def without_output(text: str) -> Iterator[Difference]:
    """Find snippets of a page that are neither exempt nor followed by their output."""
    for snippet in snippets_of(text):
        if snippet.runs(slow=True) and snippet.output is None:
            yield Difference(_line(text, snippet.start), "the snippet has no output; print a result, then run "
                             "python -m tools.snippets --write, or mark it <!-- not run: REASON -->")  # fmt: skip


def outputs_of(text: str, *, slow: bool = False) -> list[str | None]:
    """Run the snippets of a page.

    Args:
        text: Text of the page.
        slow: Whether to run the snippets marked as slow too.

    Returns:
        The output of each snippet, and None for those that do not run.

    Raises:
        SnippetError: A snippet raises an exception or a command fails.
    """
    import nbformat
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError

    snippets = snippets_of(text)
    selected = [snippet for snippet in snippets if snippet.runs(slow=slow)]
    if not selected:
        return [None] * len(snippets)
    sources = [
        snippet.code if snippet.language == "python" else f"%%bash\nset -euo pipefail\n{snippet.code}"
        for snippet in selected
    ]
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source in sources])
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(ROOT / "examples", Path(folder) / "examples", ignore=shutil.ignore_patterns("__pycache__"))
        client = NotebookClient(book, timeout=None if slow else TIMEOUT_S, kernel_name="python3",
                                extra_arguments=["--IPKernelApp.log_level=ERROR"])  # fmt: skip
        try:
            client.execute(cwd=folder, env=_environment(Path(folder)))
        except CellExecutionError as error:
            failed = next(k for k, cell in enumerate(book.cells) if any(o.output_type == "error" for o in cell.outputs))
            reason = f"{error.ename}: {error.evalue}".strip().splitlines()[0]
            notes = "".join(o.text for o in book.cells[failed].outputs if o.get("name") == "stderr").strip()
            sentence = f"the snippet fails with {reason}" + (f"\n{notes}" if notes else "")
            raise SnippetError(_line(text, selected[failed].start), sentence) from error
        printed = iter([_shown(cell.outputs).replace(f"{folder}/", "") for cell in book.cells])
    return [next(printed) if snippet.runs(slow=slow) else None for snippet in snippets]


def _environment(folder: Path) -> dict[str, str]:
    """Environment in which commands find this Python and this checkout, and print neither colours nor progress."""
    return {
        **os.environ,
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]),
        "PYTHONPATH": str(ROOT),
        "IPYTHONDIR": str(folder / ".ipython"),
        "COLUMNS": "88",
        "JAX_PLATFORMS": "cpu",
        "MPLBACKEND": "Agg",
        "NO_COLOR": "1",
        "TQDM_DISABLE": "1",
    }


def _shown(outputs: Sequence[dict]) -> str:
    """Standard output and values of a cell, with one line break at the end."""
    text = ""
    for output in outputs:
        if output.get("name") == "stdout":
            text += output["text"]
        elif output["output_type"] == "execute_result":
            text += "\n" * (bool(text) and not text.endswith("\n")) + output["data"]["text/plain"] + "\n"
    return "".join(f"{line.rstrip()}\n" for line in TIMESTAMP.sub("TIME", text).strip("\n").splitlines())


def agree(stored: str, printed: str) -> bool:
    """Compare two outputs.

    Args:
        stored: Output on the page.
        printed: Output of the snippet.

    Returns:
        Whether words and whole numbers are equal, and other numbers within the tolerance.
    """
    words, other_words = ("".join(NUMBER.sub("0", text).split()) for text in (stored, printed))
    numbers = zip(NUMBER.findall(stored), NUMBER.findall(printed), strict=False)
    return words == other_words and all(_close(*pair) for pair in numbers)


def _close(stored: tuple[str, str, str], printed: tuple[str, str, str]) -> bool:
    (text, percent, duration), other = stored, printed[0]
    if duration or text == other:
        return True
    if not percent and (text.lstrip("+-").isdigit() or other.lstrip("+-").isdigit()):
        return float(text) == float(other)
    digits, _, exponent = text.partition("e")
    unit = 10.0 ** (int(exponent or 0) - len(digits.partition(".")[2]))
    return math.isclose(float(text), float(other), rel_tol=RELATIVE_TOLERANCE, abs_tol=1.01 * unit)


def differences(text: str, outputs: Sequence[str | None]) -> Iterator[Difference]:
    """Compare the outputs below the snippets of a page with those of a run.

    Args:
        text: Text of the page.
        outputs: Outputs that `outputs_of` returned.

    Yields:
        The snippets whose output differs.
    """
    for snippet, output in zip(snippets_of(text), outputs, strict=True):
        if output is not None and not agree(snippet.output or "", output):
            sentence = f"the page shows\n{snippet.output or ''}but the snippet prints\n{output.rstrip()}"
            yield Difference(_line(text, snippet.start), sentence)


def renewed(text: str, outputs: Sequence[str | None]) -> str:
    """Replace the outputs of a page that differ from those of a run.

    Args:
        text: Text of the page.
        outputs: Outputs that `outputs_of` returned.

    Returns:
        The new text of the page. Outputs that agree are kept, so that pages do not change with the machine.
    """
    parts, end = [], 0
    for snippet, output in zip(snippets_of(text), outputs, strict=True):
        if output is not None and not agree(snippet.output or "", output):
            block = BLOCK.match(text, snippet.start)
            assert block is not None
            parts.append(text[end : block.end()] + (f"\n```output\n{output}```\n" if output else ""))
            end = snippet.end
    return "".join(parts) + text[end:]


def _line(text: str, position: int) -> int:
    return text.count("\n", 0, position) + 1


def run(args: SnippetsArgs) -> int:
    """Run the snippets of pages, and compare or renew their outputs.

    Args:
        args: Options of the command.

    Returns:
        The exit code: 1 if a snippet fails or an output differs.

    Raises:
        ValueError: A page is unknown.
    """
    pages = pages_of(ROOT)
    for name in args.names:
        if name not in pages:
            raise ValueError(f"there is no page {name}; {did_you_mean(name, pages, ', '.join(pages))}")
    failed = False
    for name in args.names or pages:
        text = pages[name].read_text()
        try:
            outputs = outputs_of(text, slow=args.all)
        except SnippetError as error:
            line, sentence = error.args
            found = [Difference(line, sentence)]
        else:
            found = list(differences(text, outputs))
            if args.write and pages[name].read_text() == text:
                pages[name].write_text(renewed(text, outputs))
                print(f"{pages[name].relative_to(ROOT)}: {len(found)} outputs renewed", flush=True)
                continue
            if args.write:
                found = [Difference(1, "the page changed while its snippets ran, and is left as it is; run again")]
        if not found:
            print(f"{pages[name].relative_to(ROOT)}: no differences", flush=True)
        failed |= bool(found)
        for line, sentence in found:
            print(f"{pages[name].relative_to(ROOT)}:{line}: {sentence}", flush=True)
    return int(failed)


main = command(SnippetsArgs, "tools.snippets")

if __name__ == "__main__":
    sys.exit(main())
