"""README.md is short, and what it and docs/ point to or tell people to type exists."""

import ast
import contextlib
import functools
import importlib.metadata
import importlib.util
import io
import re
import shlex
from pathlib import Path
from typing import Callable, Iterator, List, NamedTuple, Set
from unittest import mock
from urllib.parse import unquote

import pytest
import tyro

from sparsestyle_ns.cli import main

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]
METHODS = ("coarse-fewshot", "hier-style")
VARIANT = re.compile("-(draft|paper)$")
FLAG = re.compile(r"(?<![\w-])--[a-z][\w.-]*")
LINK = re.compile(r"!?\[[^\]]*\]\(([^()\s]+)\)")
INLINE_CODE = re.compile(r"`([^`]+)`")
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


class Command(NamedTuple):
    """A command line, by its words."""

    words: List[str]

    def named(self, *programs: str) -> bool:
        """Whether it starts with these words."""
        return tuple(self.words[: len(programs)]) == programs

    @property
    def flags(self) -> Set[str]:
        """Its flags, without values that came with an equals sign."""
        return {word.partition("=")[0] for word in self.words if word.startswith("--") and word != "--"}


def blocks(page: Path) -> Iterator[str]:
    """The page's blocks of commands."""
    return (text for language, text in FENCE.findall(page.read_text()) if language == "")


def inline_code(page: Path) -> List[str]:
    """What stands between backticks outside of blocks, on one line each."""
    return [" ".join(code.split()) for code in INLINE_CODE.findall(FENCE.sub("", page.read_text()))]


def commands(page: Path) -> List[Command]:
    """The commands in the page's blocks."""
    lines = [line for text in blocks(page) for line in text.replace("\\\n", " ").splitlines()]
    return [Command(words) for words in (shlex.split(line, comments=True) for line in lines) if words]


def headings(page: Path) -> Set[str]:
    """Anchors of the page's headings, as GitHub makes them."""
    titles = re.findall(r"^#+ (.*)$", FENCE.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def printed_help(show: Callable[[], object]) -> str:
    """What a command line prints when asked for help, not broken into narrow lines."""
    printed = io.StringIO()
    with (
        mock.patch.dict("os.environ", COLUMNS="500"),
        contextlib.redirect_stdout(printed),
        pytest.raises(SystemExit) as ended,
    ):
        show()
    assert not ended.value.code, printed.getvalue()
    return printed.getvalue()


@functools.cache
def subcommand_flags(name: str) -> Set[str]:
    """Flags of `sparsestyle NAME`."""
    return set(FLAG.findall(printed_help(lambda: main([name, "--help"]))))


@functools.cache
def subcommands() -> Set[str]:
    """All X of `sparsestyle X`."""
    choices = re.search(r"\{([\w,-]+)\}", printed_help(lambda: main(["--help"])))
    assert choices is not None
    return set(choices[1].split(","))


@functools.cache
def method_flags(method: str) -> Set[str]:
    """Flags of `ns-train METHOD` before the dataparser's name."""
    from sparsestyle_ns.method_configs import method_config

    config = method_config(method)
    return set(FLAG.findall(printed_help(lambda: tyro.cli(type(config), default=config, args=["--help"]))))


def as_flag(name: str) -> str:
    """The flag by which a field or a parameter is set."""
    return f"--{name.replace('_', '-')}"


@functools.cache
def class_flags(name: str) -> Set[str]:
    """Flags for the fields of a class of this package, wherever it stands."""
    files = [path for path in (ROOT / "sparsestyle_ns").rglob("*.py") if f"class {name}" in path.read_text()]
    classes = [
        node for path in files for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ClassDef)
    ]
    (body,) = (node.body for node in classes if node.name == name)
    return {as_flag(node.target.id) for node in body if isinstance(node, ast.AnnAssign)}


@functools.cache
def written_flags(*paths: Path) -> Set[str]:
    """Flags that scripts define: as dataclass fields or parameters, or by argparse."""
    text = "".join(path.read_text() for path in paths)
    return {as_flag(name) for name in re.findall(r"^ +(\w+): ", text, re.MULTILINE)} | set(
        re.findall(r'add_argument\("(--[\w-]+)"', text)
    )


@functools.cache
def nerfstudio_flags(program: str) -> Set[str]:
    """Flags of one of nerfstudio's own commands; none where there is no such command."""
    scripts = importlib.metadata.entry_points(group="console_scripts", name=program)
    specs = [importlib.util.find_spec(script.module) for script in scripts]
    return written_flags(*(Path(spec.origin) for spec in specs if spec and spec.origin))


def unknown_flags(command: Command) -> Set[str]:
    """The command's flags that it doesn't have."""
    words = command.words
    if command.named("ns-train") and VARIANT.sub("", words[1]) in METHODS:
        position = words.index("llff-data") if "llff-data" in words else len(words)
        before, after = Command(words[:position]), Command(words[position:])
        return (before.flags - method_flags(words[1])) | (after.flags - class_flags("LLFFDataParserConfig"))
    if words[0].startswith("ns-"):
        return command.flags - nerfstudio_flags(words[0])
    if command.named("sparsestyle"):
        passed_on = set(FLAG.findall(" ".join(word.partition("=")[2] for word in words)))
        either = method_flags("coarse-fewshot") | method_flags("hier-style")
        return (command.flags - subcommand_flags(words[1])) | (passed_on - either)
    if command.named("python", "-m"):
        folder = ROOT / "benchmarks"
        return command.flags - written_flags(
            folder / f"{words[2].removeprefix('benchmarks.')}.py", folder / "_measure.py"
        )
    if command.named("bash"):  # a script that passes its flags on to the module of its name
        module = (ROOT / words[1]).with_suffix(".py")
        return command.flags - written_flags(module, module.with_name("_measure.py"))
    if command.named("python"):
        return command.flags - written_flags(*(ROOT / "data_scripts").rglob("*.py"))
    return set()


@functools.cache
def all_flags() -> Set[str]:
    """Flags of any command of this project."""
    ours = [subcommand_flags(name) for name in subcommands()] + [method_flags(name) for name in METHODS]
    scripts = written_flags(*(ROOT / "data_scripts").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py"))
    return set().union(*ours, class_flags("LLFFDataParserConfig"), scripts)


def test_the_readme_is_a_front_door() -> None:
    assert len(README.read_text().splitlines()) <= 150


@each_page
def test_every_page_says_at_once_whom_it_is_for(page: Path) -> None:
    if page != README:
        title, gap, sentence, *_ = page.read_text().splitlines()
        assert title.startswith("# ") and gap == ""
        assert sentence.startswith("This page is for ")


@each_page
def test_links_and_pictures_resolve(page: Path) -> None:
    targets = [target for target in LINK.findall(page.read_text()) if not re.match(r"[a-z]+:", target)]
    for target in targets:
        path, _, anchor = unquote(target).partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name}: {target}"
        assert ROOT in file.parents, f"{page.name}: {target} is outside of the repository"
        if anchor:
            assert anchor in headings(file), f"{page.name}: {target}"


@each_page
def test_commands_and_their_flags_exist(page: Path) -> None:
    make_targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for command in commands(page):
        words = command.words
        known = ("bash", "make", "pip", "python", "pytest", "sparsestyle")
        assert words[0] in known or words[0].startswith("ns-"), words
        if command.named("make"):
            assert words[1] in make_targets, words
        if command.named("ns-train") and not words[1].startswith("-"):
            assert VARIANT.sub("", words[1]) in METHODS, words
        if command.named("sparsestyle"):
            assert words[1] in subcommands(), words
        if command.named("bash") or (command.named("python") and words[1] != "-m"):
            assert (ROOT / words[1]).is_file(), words
        assert not unknown_flags(command), f"{page.name}: {shlex.join(words)}"


@each_page
def test_what_sentences_name_exists(page: Path) -> None:
    for code in inline_code(page):
        for name in re.findall(r"\bsparsestyle ([a-z]+)", code):
            assert name in subcommands(), f"{page.name}: {code}"
        for name in re.findall(r"\bbenchmarks\.([a-z]\w*)", code):
            assert (ROOT / "benchmarks" / f"{name}.py").is_file(), f"{page.name}: {code}"
        if not code.startswith(("pytest", "pip")):
            unknown = set(FLAG.findall(code)) - all_flags() - {"--help", "--hypothesis-profile"}
            assert not unknown, f"{page.name}: {code}"


def test_the_check_finds_what_is_wrong() -> None:
    def unknown(line: str) -> Set[str]:
        return unknown_flags(Command(shlex.split(line)))

    assert unknown("ns-train hier-style --style-image a.jpg --gone 1 llff-data --eval-interval 4") == {"--gone"}
    assert unknown("ns-train coarse-fewshot --style-image a.jpg llff-data") == {"--style-image"}
    assert unknown("ns-train coarse-fewshot llff-data --num-views 3") == {"--num-views"}
    assert unknown("sparsestyle gallery RUN --frame 3 --frames 3") == {"--frame"}
    assert unknown("sparsestyle ablate --style-flags='--pipeline.gone 1 --pipeline.feature-side 64'") == {
        "--pipeline.gone"
    }
    assert unknown("ns-viewer --load-config a --gone") == {"--gone"}
    assert unknown("python -m benchmarks.render --quick --gone") == {"--gone"}
    assert unknown("python data_scripts/demo.py --frames 3 --gone") == {"--gone"}
