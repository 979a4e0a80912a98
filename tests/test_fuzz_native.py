"""The fuzzing script runs, knows every C function, and tells the seed of a failure."""

import subprocess
import sys

from conftest import SCRIPTS

SCRIPT = SCRIPTS / "fuzz_native.py"


def fuzz(*arguments: str, before: str = "") -> subprocess.CompletedProcess[str]:
    """Run the script, after some lines of code."""
    code = f"import runpy, sys\nsys.argv = {['fuzz', *arguments]!r}\n{before}\n"
    code += f"runpy.run_path({str(SCRIPT)!r}, None, '__main__')"
    return subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=100)


def test_no_call_fails() -> None:
    done = fuzz("--calls", "5000", "--seconds", "60")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "seeds 0 to 4999: no failure" in done.stdout


def test_a_crash_is_told_with_its_seed() -> None:
    """A function that ends the process at its third call."""
    crash = (
        "import os\nfrom colmap_sph import _native\ncount = []\n"
        "def broken(*_):\n    count.append(1)\n    if len(count) == 3: os.abort()\n"
        "for name in dir(_native):\n    if name[0] != '_' and name != 'backends': setattr(_native, name, broken)"
    )
    done = fuzz("--seconds", "20", before=crash)
    assert done.returncode == 1
    seed = int(done.stdout.split()[1])
    assert f"repeat it with --seed {seed} --calls 1" in done.stdout
    assert seed < 10  # an entry may call more than one function


def test_a_function_without_entry_is_named() -> None:
    done = fuzz("--calls", "1", before="from colmap_sph import _native\n_native.brand_new = len")
    assert done.returncode == 1
    assert "brand_new: no entry in FUNCTIONS" in done.stdout
