"""How options are spelled on the command line: everyday ones short, all others behind the name of their stage."""

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout

SHORT = {
    "undistortion.max_image_size": "--max-image-size",
    "pairs.num_pairs": "--num-pairs",
    "polish.poses": "--polish-poses",
    "polish.cameras": "--polish-cameras",
}
"""Options of stages which everybody uses, by their place in the records."""

EVERYDAY = (
    "--model",
    "--images",
    "--masks",
    "--output",
    "--workspace",
    "--quality",
    "--within",
    "--max-image-size",
    "--num-pairs",
    "--threads",
    "--memory",
    "--dry-run",
    "--overwrite",
)
"""What `run --help` shows."""

# What options mean that are typed without a value.
_ALONE = {"--polish.poses": "on", "--polish.cameras": "True"}
# Spellings of earlier versions, and what they are called now.
_RENAMED = {
    "--min-triangulation-angle": "--pairs.min-triangulation-angle",
    "--max-triangulation-angle": "--pairs.max-triangulation-angle",
    "--min-shared-points": "--pairs.min-shared-points",
    "--rectification": "--rectification.surface",
    "--sampling": "--rectification.sampling",
    "--min-cosine": "--rectification.min-cosine",
    "--near-margin": "--rectification.near-margin",
    "--far-margin": "--rectification.far-margin",
    "--max-pixels-ratio": "--rectification.max-pixels-ratio",
    "--depth.disparity-sigma": "--vote.disparity-sigma",
    "--depth.max-disparity-step": "--vote.max-disparity-step",
    "--depth.vote-tolerance": "--vote.tolerance",
    "--depth.min-support": "--vote.min-support",
    "--depth.max-reprojection-error": "--confirm.max-reprojection-error",
    "--depth.consistency-tolerance": "--confirm.tolerance",
    "--depth.min-consistent": "--confirm.min-consistent",
    "--depth.max-contradiction": "--confirm.max-contradiction",
    "--depth.min-contradicting-support": "--confirm.min-contradicting-support",
    "--depth.min-surface": "--confirm.min-surface",
    "--fusion-input": "--fusion.input",
}

# What begins with one dash and is no option: a path, or an axis.
_DASHED = re.compile(r"-(?!h$)[^-\d.]")
# A box whose first number is negative.
_NEGATIVE = re.compile(r"-(inf|[\d.])")

_ASKING_FOR_COMPLETION = "--tyro-print-completion"

_FULL = {flag: f"--{place.replace('_', '-')}" for place, flag in SHORT.items()} | _RENAMED


def flag_of(place: str) -> str:
    """An option as the user types it, from its place in the records, such as "vote.min_support"."""
    return SHORT.get(place, f"--{place.replace('_', '-')}")


def full_flag(flag: str) -> str:
    """A flag in the spelling that the records give it, from a short or an earlier one."""
    flag = flag.replace("_", "-")
    return _FULL.get(flag, flag)


def with_dashed_values(arguments: Sequence[str]) -> list[str]:
    """The arguments with a value that begins with a dash, as in ``--up -z``, joined to its option.

    Numbers stay, which the parser knows itself, and ``-h``.
    """
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1].startswith("--") and "=" not in joined[-1] and _DASHED.match(argument):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def in_full(arguments: Sequence[str]) -> list[str]:
    """The arguments of `run` with every option in the spelling that the records give it.

    Short and earlier spellings are replaced, and a first argument that is no option is the model.
    """
    spelled: list[str] = []
    for argument in [*arguments, "--"]:
        if spelled and spelled[-1] in _ALONE and argument.startswith("-"):
            spelled.append(_ALONE[spelled[-1]])
        flag, equals, value = argument.partition("=")
        if flag.startswith("--"):
            argument = full_flag(flag) + equals + value
        if spelled and spelled[-1] == "--region" and _NEGATIVE.match(argument):
            spelled[-1] += f"={argument}"  # no option, though it begins with a dash
        else:
            spelled.append(argument)
    spelled.pop()
    is_named = any(argument.partition("=")[0] == "--model" for argument in spelled)
    return ["--model", *spelled] if spelled and not spelled[0].startswith("-") and not is_named else spelled


@contextmanager
def short_completion(arguments: Sequence[str]) -> Iterator[None]:
    """Where a script for completion in shells is asked for, print it with the short spellings."""
    if not any(argument.startswith(_ASKING_FOR_COMPLETION) for argument in arguments):
        yield
        return
    script = io.StringIO()
    try:
        with redirect_stdout(script):
            yield
    finally:
        text = script.getvalue()
        for place, flag in SHORT.items():
            text = text.replace(f"--{place.replace('_', '-')}", flag)
        print(text, end="", flush=True)
