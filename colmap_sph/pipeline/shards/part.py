"""Which part of which stage a job makes."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

from colmap_sph.errors import OptionError

Item = TypeVar("Item")

StageName = Literal["prepare", "match", "vote", "confirm"]
"""What can be made on its own, in this order: all before the first pair; disparity maps; votes; geometric maps."""

_PART = re.compile(r"(\d{1,7})/(\d{1,7})", re.ASCII)


@dataclass(frozen=True)
class Part:
    """One of so many parts, counted from 1."""

    number: int = 1
    parts: int = 1

    @staticmethod
    def parse(text: str) -> "Part":
        """Read a part as it is typed; `OptionError` where it is none.

        Examples
        --------
        >>> Part.parse("3/16")
        Part(number=3, parts=16)
        """
        found = _PART.fullmatch(text.strip())
        part = Part(*map(int, found.groups())) if found else Part(0, 0)
        if not 1 <= part.number <= part.parts:
            raise OptionError(f"shard must be I/N with I from 1 to N, such as 3/16, not {text!r}.", "shard")
        return part

    def of(self, items: Sequence[Item]) -> Sequence[Item]:
        """The items of this part: neighbours, and in no part more than one fewer than in another.

        Examples
        --------
        >>> [Part(number, 3).of("abcdefgh") for number in (1, 2, 3)]
        ['ab', 'cde', 'fgh']
        """
        first, last = (len(items) * number // self.parts for number in (self.number - 1, self.number))
        return items[first:last]

    @property
    def all(self) -> Iterator["Part"]:
        """All parts of the whole that this is one of."""
        return (Part(number, self.parts) for number in range(1, self.parts + 1))

    def __str__(self) -> str:
        return f"{self.number}/{self.parts}"


def check_part(stage: StageName | None, shard: str | None) -> Part:
    """The part that is meant, of a stage; `OptionError` where the two do not go together.

    Parameters
    ----------
    stage : str or None
    shard : str or None
        As it was typed. Of both, None: not given; all of a stage is part 1 of 1.
    """
    part = Part() if shard is None else Part.parse(shard)
    if stage is None:
        raise OptionError("--shard is a part of one stage; give --stage match, vote or confirm with it.")
    if shard is not None and stage == "prepare":
        raise OptionError("--stage prepare is done once, as a whole; leave out --shard.")
    return part
