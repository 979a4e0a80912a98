"""What is said of our options → the same in COLMAP's spelling, for who has given them so."""

import re
from collections.abc import Callable

from colmap_sph.app.colmap.options import COMMANDS, ColmapCommand
from colmap_sph.app.colmap.settings import flag_of
from colmap_sph.app.option_list import option_groups
from colmap_sph.app.run_command import RunCommand

# A flag, but not in the middle of a path, and not where it is already said whose it is.
_FLAG = re.compile(r"(?<![\w/.`-])(?<!run )(?<!run` )--[a-z][a-z0-9]*(?:[._-][a-z0-9]+)*")
# Options of ours that are no settings of a stage, and which of COLMAP's say the same.
_PLAIN = {
    "patch_match_stereo": {"workspace": "workspace_path", "output": "workspace_path"},
    "stereo_fusion": {
        "workspace": "workspace_path",
        "output": "output_path",
        "fusion.input": "input_type",
        "region": "bbox_path",
    },
}


def spelling_of(name: str) -> Callable[[str], str]:
    """Return what puts a text with options of `run` into the words of a command of COLMAP's.

    Options that the command does not have are said to be those of `run`.

    Examples
    --------
    >>> spell = spelling_of("stereo_fusion")
    >>> spell("lower --fusion.min-num-pixels, or raise --num-pairs")
    'lower --StereoFusion.min_num_pixels, or raise --num-pairs (of colmap_sph run)'
    """
    command = COMMANDS.get(name)
    if command is None:
        return str
    spelled = _spelled(command)
    return lambda text: _FLAG.sub(lambda found: spelled.get(found[0], found[0]), text)


def _spelled(command: ColmapCommand) -> dict[str, str]:
    """For each flag of ours, short and in full, what to say instead."""
    spelled: dict[str, str] = {}
    own = command.flags()
    for group in option_groups(RunCommand):
        for option in group.options:
            theirs = flag_of(option.place, command.sectioned, command.section)
            if option.place in _PLAIN[command.name]:
                theirs = f"--{_PLAIN[command.name][option.place]}"
            if theirs[2:] not in own:
                theirs = f"{option.flag} (of colmap_sph run)"
            spelled |= {option.flag: theirs, option.full_flag: theirs}
    return spelled
