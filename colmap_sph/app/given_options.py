"""What the user gives as options of `run`: quality, configuration and command line, of which the last wins."""

from collections.abc import Sequence
from pathlib import Path

from colmap_sph.app.config_file import arguments_of_file
from colmap_sph.app.option_list import Option, option_groups
from colmap_sph.app.spelling import in_full
from colmap_sph.errors import OptionError
from colmap_sph.pipeline.presets import PRESETS


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
    arguments = in_full(typed)
    config = last_value(arguments, "--config")
    if config is not None:
        if config.lower().endswith(".json") and last_value(arguments, "--quality") is not None:
            raise OptionError(f"--quality has no effect, as {config} sets all options; leave out one of the two.")
        arguments = [*arguments_of_file(Path(config), known_options(command)), *arguments]
    return [*_of_quality(last_value(arguments, "--quality")), *arguments]


def _of_quality(quality: str | None) -> list[str]:
    """What a quality sets; nothing for one that there is not, which the parser refuses."""
    chosen = next((values for name, values in PRESETS.items() if name == quality), {})
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
