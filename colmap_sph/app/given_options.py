"""What the user gives as options of `run`: a configuration first, then the command line, which wins."""

from collections.abc import Sequence
from pathlib import Path

from colmap_sph.app.config_file import arguments_of_file
from colmap_sph.app.option_list import Option, option_groups
from colmap_sph.app.spelling import in_full


def all_arguments(typed: Sequence[str], command: type) -> list[str]:
    """The arguments of `run` in full, those of --config before what is typed: of two the parser takes the last.

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
    """
    arguments = in_full(typed)
    config = last_value(arguments, "--config")
    if config is not None:
        arguments = [*arguments_of_file(Path(config), known_options(command)), *arguments]
    return arguments


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
