"""Write docs/options.md: every option of `colmap_sph run`, from the records that hold them.

python scripts/make_option_docs.py
"""

from pathlib import Path

from colmap_sph.app.option_list import Option, OptionGroup, option_groups
from colmap_sph.app.run_command import RunCommand
from colmap_sph.app.spelling import EVERYDAY
from colmap_sph.pipeline.presets import PRESETS

PAGE = Path(__file__).resolve().parents[1] / "docs" / "options.md"

_HEAD = """# Options of `colmap_sph run`

Made by `scripts/make_option_docs.py` from the records in the code; `colmap_sph run --help-all` shows the same.
In Python the records are the fields of `colmap_sph.RunOptions`: `--vote.min-support 2` is
`RunOptions(vote=VoteOptions(min_support=2))`, both of `colmap_sph`.
What the stages do is told in [algorithm.md](algorithm.md).
"""


_PRESETS_TEXT = """All other options are as always, and what is given beside `--quality` wins. In Python:
`colmap_sph.preset("preview")`. What each is worth is measured in [usage.md](usage.md#quality). With
`--fusion.method colmap` the nearness of fusion is as always; in Python:
`colmap_sph.preset("best", fusion_method="colmap")`."""


def page() -> str:
    """The whole text of the page."""
    plain, *stages = option_groups(RunCommand)
    known = {option.flag: option for group in (plain, *stages) for option in group.options}
    parts = [_HEAD, "## Everyday options", _table([known[flag] for flag in EVERYDAY])]
    parts += ["## What `--quality` sets", _PRESETS_TEXT, _presets(list(plain.options), stages)]
    parts += ["## The run", _table([option for option in plain.options if option.flag not in EVERYDAY])]
    for group in stages:
        rest = [option for option in group.options if option.flag not in EVERYDAY]
        if rest:
            parts += [f"## {group.name.capitalize()}", f"{group.text}", _table(rest)]
    return "\n\n".join(part.rstrip() for part in parts) + "\n"


def _presets(plain: list[Option], stages: list[OptionGroup]) -> str:
    known = {
        option.place: option for options in (plain, *(stage.options for stage in stages)) for option in options
    }
    places = list(dict.fromkeys(place for values in PRESETS.values() for place in values))
    rows = [f"| option | {' | '.join(PRESETS)} |", "|---" * (1 + len(PRESETS)) + "|"]
    for place in places:
        option = known[place]
        values = (quality.get(place, option.default) for quality in PRESETS.values())
        chosen = ("as always" if value == "" else f"`{value}`" for value in values)
        rows.append(f"| `{option.flag}` | {' | '.join(chosen)} |")
    return "\n".join(rows)


def _table(options: list[Option]) -> str:
    rows = ["| option | default | |", "|---|---|---|"]
    for option in options:
        flag = f"{option.flag} {option.values}".rstrip()
        default = f"`{option.default}`" if option.default else ""
        rows.append(f"| `{_cell(flag)}` | {_cell(default)} | {_cell(option.text)} |")
    return "\n".join(rows)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
