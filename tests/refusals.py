"""What a refusal of an option must tell: the option, in words and as data."""

import re
from typing import Protocol

import pytest

from colmap_sph.errors import OptionError


class Options(Protocol):
    def check(self) -> None: ...


def assert_refused(options: Options, *names: str) -> OptionError:
    """`options` are refused with one sentence, which has each of the fields `names` once, as it can be spelled."""
    with pytest.raises(OptionError) as refused:
        options.check()
    error = refused.value
    assert error.names == names
    assert re.fullmatch(r"[^\n]+\.", str(error))
    for name in names:
        assert len(re.findall(rf"(?<![\w.-]){name}\b", str(error))) == 1, error
    spelled = error.spelled(lambda name: f"--room.{name}")
    assert all(f"--room.{name}" in str(spelled) for name in names)
    return error
