"""Values of checked types are read in any thread, also where nobody has read that type before."""

import subprocess
import sys

import msgspec
import pytest

from colmap_sph.project.state.typed import from_json, from_plain

# Threads that ask msgspec itself at the same time end the process at the first or second of these types.
_AT_ONCE = """
import sys, threading
import msgspec
from colmap_sph.project.state.typed import from_json, from_plain

sys.setswitchinterval(1e-6)
content = {"words": ["a"], "number": 2.5}
for _ in range(100):
    kind = msgspec.defstruct("Kind", [("words", tuple[str, ...]), ("number", float), ("more", dict[str, int], {})])
    start = threading.Barrier(4)

    def read(way, given):
        start.wait()
        assert way(given, kind).words == ("a",)

    ways = [(from_plain, content), (from_json, msgspec.json.encode(content))] * 2
    threads = [threading.Thread(target=read, args=each) for each in ways]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
print("done")
"""


def test_threads_may_read_a_new_type_at_once() -> None:
    done = subprocess.run([sys.executable, "-c", _AT_ONCE], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "done\n", "")


def test_values_of_another_type_are_refused() -> None:
    assert from_json(b"[1, 2]", tuple[int, ...]) == (1, 2)
    assert from_plain([1, 2], tuple[int, ...]) == (1, 2)
    with pytest.raises(msgspec.ValidationError):
        from_json(b'["1"]', tuple[int, ...])
    with pytest.raises(msgspec.ValidationError):
        from_plain(["1"], tuple[int, ...])
