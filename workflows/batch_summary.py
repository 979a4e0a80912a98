#!/usr/bin/env python3
"""What became of many projects: a table, and a page with links to their reports.

    workflows/batch_summary.py models.txt --output FOLDER/NAME     # after workflows/slurm_array.sh

writes FOLDER/NAME.tsv and FOLDER/NAME.html. models.txt names one sparse model per line. What `workflows/batch.sh`
gives instead are four texts for each, each with a null byte after it: model, dense workspace, exit code, message.
Needs Python and nothing else. The exit code is 1 where a project failed or was not run.
"""

import argparse
import html
import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

COLUMNS = ("project", "result", "images", "points", "coverage", "seconds", "products", "what is wrong")
# Folders of a dense workspace that other commands fill.
PRODUCTS = ("surface", "mesh", "export")
DONE = {"0": "done", "5": "incomplete"}


@dataclass(frozen=True)
class Project:
    """A model, its dense workspace, and how its run ended: "" where that is not known."""

    model: str
    dense: Path
    code: str = ""
    message: str = ""

    def row(self) -> tuple[str, ...]:
        """The cells of the table."""
        report = self._report()
        code, message = (self.code, self.message) if self.code else self._found(report)
        result = DONE.get(code, f"FAILED ({code})" if code else "not run")
        if code not in DONE or report is None:
            return (self.model, result, "", "", "", "", "", message)
        coverage = report.get("coverage", {})
        missing = {**report.get("skipped_images", {}), **report.get("incomplete", {})}
        return (
            self.model,
            result,
            str(report.get("images", "")),
            str(report.get("points", "")),
            f"{100 * sum(coverage.values()) / max(len(coverage), 1):.1f} %",
            f"{_seconds(report):.0f}",
            " ".join(folder.name for folder in self.products()),
            "; ".join(f"{name}: {reason}" for name, reason in missing.items()),
        )

    def link(self) -> Path:
        """The report to look at."""
        page = self.dense / "colmap_sph" / "report.html"
        return page if page.is_file() else page.with_suffix(".json")

    def products(self) -> list[Path]:
        """The folders of products that have something in them."""
        folders = [self.dense / name for name in PRODUCTS]
        return [folder for folder in folders if folder.is_dir() and any(folder.iterdir())]

    def _report(self) -> dict | None:
        try:
            report = json.loads((self.dense / "colmap_sph" / "report.json").read_bytes())
        except (OSError, ValueError, RecursionError):
            return None
        kinds = {"coverage": dict, "seconds": dict, "skipped_images": dict, "incomplete": dict}
        is_sound = isinstance(report, dict) and all(
            isinstance(report.get(name, kind()), kind) for name, kind in kinds.items()
        )
        numbers = [*report.get("coverage", {}).values(), *report.get("seconds", {}).values()] if is_sound else []
        return report if is_sound and all(isinstance(each, int | float) for each in numbers) else None

    def _found(self, report: dict | None) -> tuple[str, str]:
        """Exit code and message as far as the workspace tells them."""
        try:
            log = (self.dense / "colmap_sph" / "log.txt").read_text(encoding="utf-8", errors="replace")
        except OSError:
            return "", "no log: the run did not come as far as a workspace, see the log of its job"
        last = log.splitlines()[-1:] or [""]
        for word in ("Stopped: ", "Interrupted"):
            if word in last[0]:
                return "?", last[0].partition(word)[2] or "interrupted"
        if report is None:
            return "?", "it has not come to its end"
        return ("5" if report.get("skipped_images") or report.get("incomplete") else "0"), ""


def _seconds(report: dict) -> float:
    """Of the whole command; earlier versions tell those of its stages."""
    total = report.get("total_seconds")
    return total if isinstance(total, int | float) and total > 0 else sum(report.get("seconds", {}).values())


def read_projects(path: Path) -> list[Project]:
    """The projects that a file names."""
    data = path.read_bytes()
    if b"\0" in data:
        texts = [text.decode(errors="surrogateescape") for text in data.split(b"\0")[:-1]]
        return [
            Project(model, Path(dense), code, message)
            for model, dense, code, message in zip(*(texts[first::4] for first in range(4)), strict=True)
        ]
    lines = [line.removesuffix(b"\r").decode(errors="surrogateescape") for line in data.split(b"\n")]
    models = [line for line in lines if line]
    return [Project(model, default_output(Path(model))) for model in models]


def default_output(model: Path) -> Path:
    """Where `colmap_sph run` puts the result of a model, of sparse/0, sparse/1 or sparse."""
    typed = Path.cwd() / model
    there = Path(typed.anchor)
    for part in typed.parts[1:]:  # the system goes back over a link from where that leads to
        there = there / part if part != ".." else (there.resolve() if there.is_symlink() else there).parent
    if "sparse" in (there.name, there.parent.name if there.name.isdigit() else ""):
        model = there
    else:
        model = model.resolve()
    number = model.name if model.name.isdigit() else ""
    folder = model.parent if number else model
    is_one_of_many = folder.name == "sparse" and number.strip("0")
    folder = folder.parent if folder.name == "sparse" else folder
    return folder / (f"dense-{number}" if is_one_of_many else "dense")


def visible(text: str) -> str:
    """A text in one line, without what steers a terminal or cannot be written."""
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)


def as_text(rows: list[tuple[str, ...]]) -> str:
    """The table for people, with columns below each other."""
    cells = [[visible(cell) for cell in row] for row in [COLUMNS, *rows]]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in cells)


def as_page(projects: list[Project], rows: list[tuple[str, ...]], folder: Path) -> str:
    """The table as a page in a folder."""
    lines = []
    for project, (model, result, *others) in zip(projects, rows, strict=True):
        name = html.escape(visible(model))
        if project.link().is_file():
            name = _linked(project.link(), name, folder)
        style = {"done": "done", "incomplete": "incomplete"}.get(result, "failed")
        texts = dict(zip(COLUMNS[1:], (html.escape(visible(cell)) for cell in (result, *others)), strict=True))
        if texts["products"]:
            texts["products"] = " ".join(_linked(each, each.name, folder) for each in project.products())
        cells = "".join(f"<td>{text}</td>" for text in texts.values())
        lines.append(f'<tr class="{style}"><td>{name}</td>{cells}</tr>')
    head = "".join(f"<th>{name}</th>" for name in COLUMNS)
    return _PAGE.replace("HEAD", head).replace("ROWS", "\n".join(lines))


def _linked(target: Path, text: str, folder: Path) -> str:
    """A link from a page in a folder."""
    place = quote(os.fsencode(os.path.relpath(target, folder)))
    return f'<a href="./{html.escape(place)}">{text}</a>'


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>colmap_sph: projects</title>
<style>
body { font: 15px/1.4 system-ui, sans-serif; margin: 2em; }
div { overflow-x: auto; }
table { border-collapse: collapse; }
th, td { text-align: left; padding: .3em .8em; border-bottom: 1px solid #ccc; vertical-align: top; }
.incomplete td:nth-child(2) { color: #8a5a00; }
.failed td:nth-child(2) { color: #b00020; font-weight: bold; }
</style></head>
<body><h1>Projects</h1><div><table><thead><tr>HEAD</tr></thead><tbody>
ROWS
</tbody></table></div></body></html>
"""


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("projects", type=Path)
    parser.add_argument("--output", type=Path, required=True, help="path of the files, without their endings")
    given = parser.parse_args()
    try:
        projects = read_projects(given.projects)
        rows = [project.row() for project in projects]
        table = "\n".join("\t".join(map(visible, row)) for row in [COLUMNS, *rows]) + "\n"
        given.output.with_name(given.output.name + ".tsv").write_text(table, encoding="utf-8")
        page = as_page(projects, rows, given.output.parent)
        given.output.with_name(given.output.name + ".html").write_text(page, encoding="utf-8")
    except OSError as error:
        print(f"error: {error.filename} cannot be used ({error.strerror}).", file=sys.stderr)
        return 3
    failed = sum(row[1] not in DONE.values() for row in rows)
    print(f"==== {len(rows)} projects, {failed} failed\n{as_text(rows)}")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
