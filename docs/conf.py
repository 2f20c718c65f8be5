"""Configuration of the site: python -m sphinx -W -c docs . build/site (pip install -e ".[docs]").

The pages are Markdown files of this folder, of the root and of the examples, and the notebooks. The build generates a
page for each command in docs/commands, from its help, and the page of the names of the library, from their docstrings.
A link, an anchor or a name of i2t without a target is a warning. The build needs no network; `-b linkcheck` tests
external links and needs one.

The notebooks run during the build, which takes minutes (docs/testing.md); their outputs are cached in build/ until a
notebook changes. `-D nb_execution_mode=off` shows them without outputs.
"""

import ast
import contextlib
import importlib
import inspect
import os
import pkgutil
import re
import sys
import textwrap
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import imagesize
from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.errors import ExtensionError

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))
os.environ["COLUMNS"] = "88"  # width of the commands' help, which fits the page
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ["PYTHONPATH"] = str(DOCS.parent)  # notebooks run with this checkout
os.environ["TQDM_DISABLE"] = "1"  # else their pages show every step of a progress bar

import i2t
from i2t.cli.commands import COMMANDS, EXPERIMENTS
from tools.check_docs import pages
from tools.reproduce.limits_table import safety_limits

project = "i2t"
author = project_copyright = "The i2t maintainers"
release = version = i2t.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
html_theme = "furo"
html_title = f"i2t {release}"
html_static_path = ["_static"]
html_css_files = ["i2t.css"]
html_show_sphinx = False
html_copy_source = False
html_extra_path = ["_static/index.html"]  # redirects to the first page
root_doc = "docs/index"
include_patterns = [
    "README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/*.md", "docs/commands/*.md", "examples/*/README.md",
    "notebooks/*.ipynb",
]  # fmt: skip
exclude_patterns = [".*", "build", "runs", "data"]
nitpicky = True
nitpick_ignore = [("py:class", "numpy.ndarray")]  # its inventory needs a network
nitpick_ignore_regex = [
    (
        "py:class",
        r"i2t\..*\.(?:ContactPressure|PopulationGP|PressureModelConfig|StructuredGPHyperparameters|TouchModel)",
    )
]  # types that the pages do not describe
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence", "dollarmath"]
html_math_renderer = "mathml"  # browsers draw it without a script or a network
highlight_language = "bash"  # language of blocks without one, which hold commands
nb_execution_mode = "cache"
nb_execution_in_temp = True  # leaves the checkout unchanged
nb_execution_timeout = 900  # s for each cell
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_output_stderr = "remove"
copybutton_selector = "div:not(.highlight-output):not(.highlight-text) > div.highlight > pre"
copybutton_exclude = ".linenos, .gp, .go"  # prompts and output of a console are not copied
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings already state shapes and units
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_attr_annotations = False
# Pages do not have to be in a table of contents.
suppress_warnings = ["toc.not_included"]

SECOND_TIER = (
    "i2t.paper",
    "i2t.simulation",
    "i2t.prediction",
    "i2t.recognition",
    "i2t.hardware",
    "i2t.viz",
    "i2t.skin_models",
)  # packages whose listed names are documented
MODULES = (
    "i2t.recognition.recognizer",
    "i2t.skin_models.pad_model",
    "i2t.skin_models.calibration",
    "i2t.models",
    "i2t.hardware.protocols",
    "i2t.hardware.plugins",
    "i2t.dataset.store",
    "i2t.dataset.splits",
    "i2t.errors",
)  # modules whose members are all documented
WIDE = 1.6  # width / height from which a figure scrolls on narrow screens
GENERATED = {"docs/reference_commands": "commands_page", "docs/reference_api": "api_page"}
CODE = re.compile(r"^(`{3,})[^`].*?^\1$|^#.*?$", re.M | re.S)  # code blocks, and headings: a link would change anchors
NAME = re.compile(r"(?<!\[)`(((?:i2t|experiments|tools)(?:\.\w+)+)(?:\([^`]*\))?)`")


def subcommands_of(text: str) -> list[str]:
    """Subcommands or parts that the help of a command lists."""
    _, _, listed = text.partition("─ subcommands ─")
    parts = re.search(r"each with its own\s+--help:\s+([\w,\s]+)\.", text)
    return re.findall(r"^│   • ([\w-]+)", listed, re.M) + (re.split(r",\s+", parts[1])[1:] if parts else [])


def _help(command: str, part: str = "") -> str:
    text = pages.help_of(command, part)
    return re.sub(r"^(?:[\w(`]|--).*(?:\n(?:[\w(`]|--).*)*", _wrapped, text, flags=re.M)


def _wrapped(paragraph: re.Match[str]) -> str:
    """Wrap a paragraph to the width of the page. Options and examples are indented or boxed, and do not match."""
    return textwrap.fill(paragraph[0], int(os.environ["COLUMNS"]), break_on_hyphens=False)


def listed_commands() -> dict[str, dict[str, str]]:
    """Commands for users with their purposes, as they are typed, under the title of their group."""
    return {
        "The library": {f"i2t {name}": command.purpose for name, command in COMMANDS.items()},
        "The experiments, which need a checkout": {
            f"python -m {name}": purpose for name, purpose in EXPERIMENTS.items()
        },
    }


def page_name(command: str) -> str:
    """Name of the page of a command."""
    return re.sub(r"\W+", "-", command.removeprefix("python -m "))


def commands_page() -> str:
    """Page that lists all commands with their purposes."""
    lines = ["# Commands and their options", "", "Each command has a page with its `--help`.", ""]
    for title, commands in listed_commands().items():
        lines += [f"## {title}", ""]
        lines += [f"- [`{name}`](commands/{page_name(name)}.md): {purpose}" for name, purpose in commands.items()]
        lines += ["", "```{toctree}", ":hidden:", *(f"commands/{page_name(name)}" for name in commands), "```", ""]
    return "\n".join(lines)


def command_page(command: str, purpose: str) -> str:
    """Page of a command: the help of the command and of each of its subcommands."""
    typed = command.removeprefix("python -m ")
    lines = [f"# {command}", "", f"{purpose[0].upper()}{purpose[1:]}{'' if purpose.endswith('?') else '.'}", ""]
    lines += ["````text", _help(typed).rstrip(), "````", ""]
    for name in subcommands_of(_help(typed)):
        lines += [f"## {name}", "", "````text", _help(typed, name).rstrip(), "````", ""]
    return "\n".join(lines)


def write_command_pages(app: Any) -> None:
    """Write the pages of the commands, which git ignores, and remove those of commands that no longer exist."""
    docs = Path(app.srcdir) / "docs"
    if not (docs / "reference_commands.md").exists():
        return
    folder = docs / "commands"
    folder.mkdir(exist_ok=True)
    commands = {name: purpose for group in listed_commands().values() for name, purpose in group.items()}
    pages = {folder / f"{page_name(name)}.md": command_page(name, purpose) for name, purpose in commands.items()}
    for path, text in pages.items():
        if not path.exists() or path.read_text() != text:  # unchanged pages are not built again
            path.write_text(text)
    for path in set(folder.glob("*.md")) - pages.keys():
        path.unlink()


def api_page() -> str:
    """Page of the public names, the packages of the second tier, and some modules."""
    lines = ["# Names of the library", "", "The names that `import i2t` provides come first.", ""]
    lines += ["```{eval-rst}", ".. highlight:: python", "```", ""]
    for name in face_names():
        lines += [f"## {name}", "", "```{eval-rst}", *_entry(f"i2t.{name}"), "```", ""]
    for package in SECOND_TIER:
        own = names_of(package)
        lines += [f"## {package}", "", "```{eval-rst}", f".. automodule:: {package}", "   :no-members:", ""]
        for name in own:
            lines += [*_entry(f"{package}.{name}"), ""]
        elsewhere = [name for name in pkgutil.resolve_name(package).__all__ if name not in own]
        lines += (
            [f"{package} also provides {', '.join(elsewhere)}, which have entries of their own."] if elsewhere else []
        )
        lines += ["```", ""]
    for module in MODULES:
        shown = [name for name in face_names() if getattr(i2t, name).__module__ == module]  # documented above
        lines += [f"## {module}", "", "```{eval-rst}", f".. automodule:: {module}", "   :members:"]
        lines += [f"   :exclude-members: {', '.join(shown)}", "```", ""]
    lines += ["## Safety limits", "", "The table of `i2t.hardware.limits`, with the test of each limit.", ""]
    lines += [safety_limits(), "", "## Other names on these pages", "", "```{eval-rst}", ".. py:currentmodule:: None"]
    others = other_names()
    for name in sorted(others, key=lambda name: (inspect.ismodule(others[name]), name)):
        lines += ["", f".. {_directive(others[name])}:: {name}"]
        if inspect.ismodule(others[name]):
            sentence, *_ = re.split(r"[.?:]\s", others[name].__doc__ or "")
            lines += ["", f"``{name}``: {' '.join(sentence.split()).rstrip('.')}."]
    return "\n".join([*lines, "```", ""])


def other_names() -> dict[str, Any]:
    """Values that pages name outside the public names and the second tier, by those names.

    Names without a value are left out, so that Sphinx warns about them on their page.
    """
    values = {}
    for pattern in include_patterns:
        for page in DOCS.parent.glob(pattern):
            for _, name in NAME.findall(CODE.sub("", page.read_text())):
                with contextlib.suppress(ImportError, AttributeError):
                    values[name] = pkgutil.resolve_name(name)
    public = {f"i2t.{name}" for name in i2t.__all__}
    classes = {f"i2t.{name}" for name in face_names()}  # their members are documented with them
    public |= {f"{package}.{name}" for package in SECOND_TIER for name in names_of(package)}
    return {
        name: value
        for name, value in values.items()
        if not name.startswith(MODULES) and name not in public and name.rpartition(".")[0] not in classes
    }


def face_names() -> list[str]:
    """Public names except the packages of the second tier."""
    return [name for name in i2t.__all__ if f"i2t.{name}" not in SECOND_TIER]


def names_of(package: str) -> list[str]:
    """Names that a package of the second tier lists, without those that have another entry on the page."""
    values = {name: getattr(pkgutil.resolve_name(package), name) for name in pkgutil.resolve_name(package).__all__}
    others = {id(getattr(i2t, name)) for name in face_names()}
    return [
        name
        for name, value in values.items()
        if id(value) not in others and getattr(value, "__module__", None) not in MODULES
    ]


def _entry(name: str) -> list[str]:
    """Lines of the directive that documents a value by its docstring."""
    value = pkgutil.resolve_name(name)
    members = isinstance(value, type) and not issubclass(value, Exception)
    return [f".. {_directive(value)}:: {name}", *["   :members:"] * members]


def _directive(value: Any) -> str:
    """Name of Sphinx's directive for a value."""
    if inspect.ismodule(value):
        return "py:module"
    return "autoclass" if isinstance(value, type) else "autofunction" if callable(value) else "py:data"


def linked(text: str) -> str:
    """Link the names of code on a page to their entries."""
    parts, end = [], 0
    for code in [*CODE.finditer(text), None]:
        prose = text[end : code.start() if code else len(text)]
        parts += [NAME.sub(r"{py:obj}`\1 <\2>`", prose), code[0] if code else ""]
        end = code.end() if code else end
    return "".join(parts)


def setup(app: Any) -> None:
    """Generate pages, and prepare docstrings for Sphinx."""

    def outdated(app: Any, env: Any, added: set[str], changed: set[str], removed: set[str]) -> list[str]:
        return [name for name in GENERATED if name in env.found_docs]

    def read(app: Any, docname: str, content: list[str]) -> None:
        if docname in GENERATED:
            content[0] = globals()[GENERATED[docname]]()
        elif docname != "CHANGELOG" and not docname.startswith("notebooks/"):  # one names the past, others are JSON
            content[0] = linked(content[0])

    app.add_html_math_renderer("mathml", inline_renderers=(draw_inline, None), block_renderers=(draw_block, None))
    app.connect("builder-inited", write_command_pages)
    app.connect("env-get-outdated", outdated)
    app.connect("source-read", read)
    app.connect("autodoc-process-docstring", literal_code, priority=100)  # before napoleon
    app.connect(
        "autodoc-process-docstring", field_comment, priority=900
    )  # after napoleon, which takes words before a colon for a type
    app.connect("html-page-context", keep_together)


def keep_together(app: Any, pagename: str, template: str, context: dict[str, Any], doctree: Any) -> None:
    """Mark words that must not be split, and lines of code, for the style sheet; link pictures to their files."""
    body = context.get("body") or ""
    body = re.sub(r"(<pre>(?:<span></span>)?)(.*?)(</pre>)", _code_lines, body, flags=re.S)
    for words in (
        r"(?<=[\s>])--?[a-z][\w.-]*(?![^<]*>)",  # an option
        r"\b\d[\d.]*e-\d+(?![^<]*>)",  # a number
        r"<math[^>]*>(?:(?!</math>).)*</math>[.,;:)]+",  # a formula and the sign behind it
    ):
        body = re.sub(words, r'<span class="together">\g<0></span>', body, flags=re.S)
    body = re.sub(r"\[[-+\d][^\]<]*, [^\]<]*\](?=[^<]*</p></td>)", r'<span class="interval">\g<0></span>', body)
    sizes = {name: Path(app.srcdir) / path for path, name in app.builder.images.items()}

    def linked_image(image: re.Match[str]) -> str:
        """Link an image to its file. Wide ones scroll on narrow screens, where they would be unreadable."""
        path = sizes.get(unquote(image[1].rpartition("/")[2]))
        width, height = imagesize.get(path) if path and path.exists() else (0, 1)
        kind = "figure wide" if width > WIDE * height else "figure"
        return f'<a class="{kind}" href="{image[1]}">{image[0]}</a>'

    context["body"] = re.sub(r'<img [^>]*src="([^"]+)"[^>]*>', linked_image, body)


def _code_lines(block: re.Match[str]) -> str:
    def marked(line: str) -> str:
        words = re.sub(r"<[^>]*>", "", line)
        indent = len(words) - len(words.lstrip())
        return f'<span class="line" style="--indent: {indent}">{line}</span>' if words else line

    return block[1] + "\n".join(map(marked, block[2].split("\n"))) + block[3]


def draw_inline(writer: Any, node: nodes.math) -> None:
    """Write an inline formula as MathML."""
    writer.body.append(_mathml(node))
    raise nodes.SkipNode


def draw_block(writer: Any, node: nodes.math_block) -> None:
    """Write a displayed formula as MathML."""
    writer.body.append(f'<div class="math">{_mathml(node, as_block=True)}</div>')
    raise nodes.SkipNode


def _mathml(node: nodes.math | nodes.math_block, as_block: bool = False) -> str:
    try:
        return tex2mathml(node.astext(), as_block=as_block)
    except MathError as error:
        raise ExtensionError(f"{node.source}: {error}: {node.astext()}") from error


def literal_code(app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Show examples and indented blocks of a module's docstring as code, and Returns as plain text."""
    shown: list[str] = []
    inside = False
    for number, line in enumerate(lines):
        if line.strip() == "Example:":
            shown += ["", ".. rubric:: Example", "", "::", ""]
            inside = True
            continue
        if line.strip() == "Returns:":  # napoleon would take words before a colon for a type
            inside = False
            shown.append("")
            lines[number + 1] = f":returns: {lines[number + 1].strip()}"
            continue
        begins = line.startswith("    ") and number > 0 and not lines[number - 1].strip()
        if what == "module" and begins and not inside:
            shown += ["::", ""]
            inside = True
        elif inside and line.strip() and not line.startswith("    "):
            inside = False
            shown.append("")
        shown.append(re.sub(r": (\w\.)$", r": \\\1", line))  # "timeout: s." is a unit, not a list
    lines[:] = shown


def field_comment(app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Describe a field of a named tuple by its comment in the source instead of "Alias for field number 0"."""
    if lines and lines[0].startswith("Alias for field number"):
        *module, kind, field = name.split(".")
        lines[:] = [comments_of(getattr(importlib.import_module(".".join(module)), kind)).get(field, ""), ""]


@cache
def comments_of(kind: type) -> dict[str, str]:
    """Comments of the fields of a class, behind or above each field, as reStructuredText."""
    source = textwrap.dedent(inspect.getsource(kind))
    lines = source.splitlines()
    comments = {}
    for node in ast.parse(source).body[0].body:
        if isinstance(node, ast.AnnAssign):
            comment = lines[node.end_lineno - 1].encode()[node.end_col_offset :].decode().strip()
            above = node.lineno - 1
            while not comment.startswith("#") and above and lines[above - 1].strip().startswith("#"):
                above -= 1
            block = [comment] if comment else lines[above : node.lineno - 1]
            words = " ".join(line.strip().removeprefix("#").strip() for line in block).removesuffix(":")
            parts = re.split(r"(`[^`]*`)", words)  # code stays unchanged
            comments[node.target.id] = "".join(
                part if part[:1] == "`" else re.sub(r"([*|_\\])", r"\\\1", part) for part in parts
            )
    return comments
