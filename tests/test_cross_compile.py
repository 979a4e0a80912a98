"""What the check of other platforms refuses."""

import importlib
from types import ModuleType

import pytest

SAID = "census 1 1 1 32 b05018b6e79c79d3\nwine: created a folder\nkernels: avx2\nkernels: neon\nkernels: scalar\n"


@pytest.fixture
def cross(scripts_on_path: None) -> ModuleType:
    return importlib.import_module("cross_compile")


def test_targets_must_give_the_same(cross: ModuleType) -> None:
    first, second, *_ = cross.TARGETS
    others: dict[str, list[str]] = {}
    assert cross.compare(SAID, others, first).startswith("1 results of kernels, the same by avx2, neon, scalar")
    assert cross.compare(SAID, others, second).endswith(f"the same as on {first.name}")
    for other in (SAID.replace("b0", "b1"), SAID.partition("\n")[2]):
        with pytest.raises(cross.CheckError, match=f"differ from those on {first.name}"):
            cross.compare(other, others, second)


def test_a_processor_taken_for_a_lesser_one_is_told(cross: ModuleType) -> None:
    (arm,) = (target for target in cross.TARGETS if target.emulator == "qemu")
    with pytest.raises(cross.CheckError, match="scalar alone, where the processor has neon"):
        cross.compare(SAID.replace("kernels: neon\n", "").replace("kernels: avx2\n", ""), {}, arm)


def test_wheels_are_named_as_pip_looks_for_them(cross: ModuleType) -> None:
    names = [target.name for target in cross.TARGETS]
    assert names[:3] == ["manylinux_2_28_x86_64", "manylinux_2_28_aarch64", "win_amd64"]
    assert names[3:] == ["macosx_14_0_arm64", "macosx_14_0_x86_64"]
