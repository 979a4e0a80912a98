"""Options as COLMAP calls them → ours; and ours, in what is said of them, as COLMAP calls them."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from colmap_sph.app.colmap.options import ColmapOption, Value
from colmap_sph.errors import ColmapSphError, OptionError
from colmap_sph.pipeline.options import RunOptions


class WrongOptionError(ColmapSphError):
    """A wrong option, in COLMAP's words and with its exit code."""

    exit_code = 1


def run_options(
    chosen: Mapping[str, Value],
    table: tuple[ColmapOption, ...],
    section: str,
    others: Mapping[str, Value] | None = None,
) -> RunOptions:
    """Return our options with those set that the user chose.

    Parameters
    ----------
    chosen : mapping of str to value
        By COLMAP's names, without section.
    table : tuple of ColmapOption
    section : str
    others : mapping of str to value, optional
        Further options, by their places in `RunOptions`.

    Raises
    ------
    WrongOptionError
        A value is out of bounds; the message calls the option as COLMAP does.
    """
    settings: dict[str, Any] = dict(others or {})
    for option in table:
        if option.name in chosen and option.target:
            settings[target_of(option)] = _as_ours(option, chosen[option.name])
    options = RunOptions()
    for place, value in settings.items():
        stage, _, name = place.rpartition(".")
        if stage:
            options = replace(options, **{stage: replace(getattr(options, stage), **{name: value})})
        else:
            options = replace(options, **{name: value})
    with spelled_as_colmap(table, section):
        options.check()
    return options


@contextmanager
def spelled_as_colmap(table: tuple[ColmapOption, ...], section: str) -> Iterator[None]:
    """Turn errors in options of ours into errors in COLMAP's."""
    try:
        yield
    except OptionError as error:
        spelled = error.spelled(lambda place: flag_of(place, table, section))
        raise WrongOptionError(str(spelled)) from None


def target_of(option: ColmapOption) -> str:
    """The place in `RunOptions` that an option sets."""
    return option.target + option.name if option.target.endswith(".") else option.target


def flag_of(place: str, table: tuple[ColmapOption, ...], section: str) -> str:
    """An option of ours, such as "fusion.min_num_pixels", as COLMAP's user types it."""
    for option in table:
        if option.target and target_of(option) == place:
            return f"--{section}.{option.name}"
    return f"--{place.replace('_', '-')}"


def _as_ours(option: ColmapOption, value: Value) -> Any:
    if option.name == "num_threads":  # -1, or 0: all cores
        return max(int(value), 0)
    if option.name == "mask_path":
        return Path(str(value)) if value else None
    return value


def check_workspace(plain: Mapping[str, Value]) -> None:
    """Raise `WrongOptionError` for a workspace of PMVS, or of no format that COLMAP knows."""
    form = str(plain["workspace_format"])
    if form.lower() == "pmvs":
        raise WrongOptionError(
            "--workspace_format PMVS is not supported; undistort with image_undistorter --output_type COLMAP."
        )
    if form.lower() != "colmap":
        raise WrongOptionError(f"--workspace_format must be COLMAP, not {form!r}.")
