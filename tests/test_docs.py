"""The documents: links lead somewhere, named modules exist, the README is short."""

import re
import shlex
from collections import Counter
from itertools import pairwise
from pathlib import Path

import pytest

import colmap_sph
from colmap_sph.app import cli
from colmap_sph.app.colmap.options import COMMANDS
from colmap_sph.app.colmap.parser import parse
from colmap_sph.app.option_list import option_groups

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "colmap_sph"
# Made or written elsewhere, may be missing.
DOCUMENTS = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
_FENCE = re.compile(r"^(```|~~~).*?^\1", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
_CODE = re.compile(r"`([^`\n]+)`")
_PATH = re.compile(r"(?<![\w./-])[\w/-]+\.(?:py|sh)\b")


def prose(document: Path) -> str:
    """The text without its blocks of code."""
    return _FENCE.sub("", document.read_text(encoding="utf-8"))


def anchors(document: Path) -> set[str]:
    """Anchors of a document's headings, as GitHub makes them."""
    found: Counter[str] = Counter()
    names = set()
    for heading in re.findall(r"^#+ (.+)$", prose(document), re.MULTILINE):
        words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").strip().lower()
        name = re.sub(r"[^\w\- ]", "", words).replace(" ", "-")
        names.add(f"{name}-{found[name]}" if found[name] else name)
        found[name] += 1
    return names


def links(document: Path) -> list[str]:
    """Targets of relative links and images."""
    return [target for target in _LINK.findall(prose(document)) if not re.match(r"[a-z]+:", target)]


def links_of_all() -> list[tuple[Path, str]]:
    return [(document, target) for document in DOCUMENTS for target in links(document)]


@pytest.mark.parametrize(("document", "target"), links_of_all(), ids=lambda each: getattr(each, "name", each))
def test_links_lead_somewhere(document: Path, target: str) -> None:
    path, _, anchor = target.partition("#")
    there = (document.parent / path).resolve() if path else document
    assert there.is_relative_to(ROOT) and there.exists()
    if anchor:
        assert anchor in anchors(there)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_named_files_exist(document: Path) -> None:
    """A path in backticks is one of the repository, its scripts, the package, or one of its rooms."""
    rooms = [ROOT, ROOT / "scripts", PACKAGE, *(folder for folder in PACKAGE.iterdir() if folder.is_dir())]
    named = {name for code in _CODE.findall(prose(document)) for name in _PATH.findall(code)}
    assert {name for name in named if not any((room / name).exists() for room in rooms)} == set()


def test_every_figure_is_shown() -> None:
    shown = {(document.parent / target).resolve() for document, target in links_of_all()}
    assert set((ROOT / "docs").rglob("*.png")) <= shown


def test_figures_are_small() -> None:
    for figure in (ROOT / "docs" / "figures").glob("*.png"):
        assert figure.stat().st_size <= 250 * 1024, figure


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


def test_shares_are_written_in_one_way() -> None:
    """As "12.3 %", in pages, in the terminal and in what examples print."""
    written = re.compile(r"\d%(?![\w])|:\.\d%")
    texts = [*DOCUMENTS, *PACKAGE.rglob("*.py"), *(ROOT / "workflows").rglob("*.py")]
    found = [
        f"{path.name}: {line}"
        for path in texts
        for line in path.read_text("utf-8").splitlines()
        if written.search(line)
    ]
    assert not found


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_headings_are_nested(document: Path) -> None:
    levels = [len(marks) for marks in re.findall(r"^(#+) ", prose(document), re.MULTILINE)]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(deeper - level <= 1 for level, deeper in pairwise(levels))


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_formulas_are_closed(document: Path) -> None:
    """GitHub reads a formula within one line, or between lines of `$$`."""
    blocks = re.split(r"^\$\$$", prose(document), flags=re.MULTILINE)
    assert len(blocks) % 2 == 1
    for text in blocks[::2]:
        plain = _CODE.sub("", text)
        assert all(line.count("$") % 2 == 0 for line in plain.splitlines())


def test_ci_finds_its_command() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert ".venv/bin/pytest" in next(line for line in lines if ".[test]" in line)


# ---- what is typed -----------------------------------------------------------------------------------------

# Options in backticks that are those of other programs and of scripts.
_OF_OTHERS = {
    *(f"--{kind}.use_gpu" for kind in ("FeatureExtraction", "FeatureMatching", "SiftExtraction", "SiftMatching")),
    *(
        "--cpus-per-task",
        "--executor",
        "--keep-going",
        "--memory-limit",
        "--nthreads",
        "--platform",
        "--resources",
        "--scene",
    ),
}
_COMMAND = re.compile(r"\s*(?:(?:\S*/)?colmap_sph|colmap(?= (?:patch|stereo))) (\w+ [^#|>;&]+)")
# Something is left out of it, or to be filled in.
_PATTERN = re.compile(r"…|[\[\]$]|\b[A-Z]+\b(?!:)")
# Not of what was so in earlier versions.
_CURRENT = [document for document in DOCUMENTS if document.name != "CHANGELOG.md"]


def commands_in(document: Path) -> list[str]:
    """Commands of ours in blocks of code and in backticks, without what the shell does."""
    text = document.read_text(encoding="utf-8")
    blocks = [match[0] for match in _FENCE.finditer(text)] + re.findall(r"^ {4}.*$", text, re.MULTILINE)
    lines = [line for block in blocks for line in block.splitlines()] + _CODE.findall(prose(document))
    found = (_COMMAND.match(line) for line in lines)
    return [match[1].strip() for match in found if match and not _PATTERN.search(match[1])]


COMMAND_LINES = sorted({(document.name, line) for document in _CURRENT for line in commands_in(document)})


def test_pages_have_commands() -> None:
    told = {page for page, _ in COMMAND_LINES}
    assert {"README.md", "usage.md", "surveyor.md", "cluster.md", "surface.md", "splats.md", "wide.md"} <= told


@pytest.mark.parametrize(("page", "line"), COMMAND_LINES)
def test_commands_are_understood(page: str, line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the parser; nothing is done."""
    monkeypatch.setattr(cli, "_do", lambda *_: 0)
    name, *options = shlex.split(line)
    if name in COMMANDS:
        parse(COMMANDS[name], options)
    else:
        assert cli.main([name, *options]) == 0


def test_no_block_makes_a_product_twice_in_one_place() -> None:
    """The second command is refused, unless it says what to do with what the first one made."""
    found = 0
    for document in _CURRENT:
        for block in _FENCE.finditer(document.read_text(encoding="utf-8")):
            made: set[tuple[str, ...]] = set()
            for match in filter(None, map(_COMMAND.match, block[0].splitlines())):
                words = shlex.split(match[1])
                if words[0] in ("surface", "mesh") and not {"--output", "--overwrite"} & {*words}:
                    assert tuple(words[:2]) not in made, (document.name, match[0])
                    made.add(tuple(words[:2]))
                    found += 1
    assert found


def test_options_in_backticks_are_there() -> None:
    known = {"--help", "--help-all", "--project_path", *_OF_OTHERS}
    for name in cli.commands():
        known |= {option.flag for group in option_groups(cli.commands()[name]) for option in group.options}
    known |= {flag.replace("--", "--no-", 1) for flag in known}
    known |= {f"--{flag}" for command in COMMANDS.values() for flag in command.flags()}
    for document in _CURRENT:
        for code in _CODE.findall(document.read_text(encoding="utf-8")):
            if code.startswith("--"):
                assert set(re.findall(r"(?<!\S)--[A-Za-z][\w.-]*", code)) <= known, (document.name, code)


def test_python_in_pages_calls_what_there_is() -> None:
    blocks = [
        (document.name, block)
        for document in _CURRENT
        for block in re.findall(
            r"^```python\n(.*?)^```", document.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
        )
    ]
    assert {page for page, _ in blocks} >= {"README.md", "usage.md", "wide.md"}
    for page, block in blocks:
        compile(block, page, "exec")
        called = set(re.findall(r"\b(?:cs|(?<!from )colmap_sph)\.([A-Za-z]\w*)", block))
        assert called <= set(dir(colmap_sph)), page
