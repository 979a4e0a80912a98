"""What the user gives as options of `run`: quality, configuration and command line, of which the last wins."""

from collections.abc import Sequence
from pathlib import Path

from colmap_sph.app.config_file import arguments_of_file
from colmap_sph.app.option_list import Option, option_groups
from colmap_sph.app.spelling import in_full
from colmap_sph.errors import OptionError
from colmap_sph.pipeline.presets import PRESETS, values_of
from colmap_sph.stereo.fusion import FusionOptions


def all_arguments(typed: Sequence[str], command: type) -> list[str]:
    """The arguments of `run` in full, those that --quality and --config stand for before what is typed.

    Of an option that is given twice the parser takes the last.

    Parameters
    ----------
    typed : sequence of str
    command : type
        The record of the command's options.

    Returns
    -------
    list of str

    Raises
    ------
    InputError
        The configuration cannot be used.
    OptionError
        It leaves nothing to the quality.
    """
    arguments = _with_config(in_full(typed), command)
    quality = last_value(arguments, "--quality")
    if quality is not None and last_value(arguments, "--within"):
        raise OptionError("--within chooses the quality by the time there is; leave out it or --quality.")
    return [*_of_quality(quality, last_value(arguments, "--fusion.method")), *arguments]


def _with_config(arguments: list[str], command: type) -> list[str]:
    config = last_value(arguments, "--config")
    if config is None:
        return arguments
    for flag in ("--quality", "--within"):
        if config.lower().endswith(".json") and last_value(arguments, flag) is not None:
            raise OptionError(f"{flag} has no effect, as {config} sets all options; leave out one of the two.")
    return [*arguments_of_file(Path(config), known_options(command)), *arguments]


def given_places(typed: Sequence[str], command: type) -> set[str]:
    """Places in the records of the options that are given, typed or in a configuration."""
    flags = {argument.partition("=")[0] for argument in _with_config(in_full(typed), command)}
    return {option.place for flag, option in known_options(command).items() if flag in flags}


def _of_quality(quality: str | None, fusion: str | None) -> list[str]:
    """What a quality sets for a method of fusion; nothing for one that there is not, which the parser refuses."""
    known = next((name for name in PRESETS if name == quality), None)
    chosen = {} if known is None else values_of(known, fusion or FusionOptions().method)
    return [f"--{place.replace('_', '-')}={value}" for place, value in chosen.items()]


def known_options(command: type) -> dict[str, Option]:
    """All options by their full flag."""
    return {option.full_flag: option for group in option_groups(command) for option in group.options}


def last_value(arguments: Sequence[str], flag: str) -> str | None:
    """What an option is set to, where it is given."""
    value = None
    for argument, following in zip(arguments, [*arguments[1:], None], strict=False):
        name, equals, text = argument.partition("=")
        if name == flag:
            value = text if equals else following
    return value
