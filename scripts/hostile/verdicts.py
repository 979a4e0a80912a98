"""What a run must not do, whatever it was given; each violation is one `Finding`."""

import filecmp
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from compare_workspaces import result_files
from numpy.typing import NDArray

from hostile.cases import GIB, Case
from hostile.grounds import Grounds, depth_path, read_depth, score_of
from hostile.runs import Outcome
from hostile.watch import Snapshot, changes, content_of, outside

# More memory than four tiny images can take, by whatever road.
_MEMORY = 1 * GIB
# Of sound input, more bad depths than this share and those of the clean run are a wrong result; of damaged input,
# which may say something slightly different, more than the second share.
_WORSE = 0.10
_GARBAGE = 0.50
_EMPTIER = 0.5
_MOST_SEEN = "N_0_1.png"


@dataclass(frozen=True)
class Finding:
    """Something that must not be: a word for the table, and the facts."""

    verdict: str
    facts: str


def judge(case: Case, outcome: Outcome, grounds: Grounds, before: Snapshot, after: Snapshot) -> list[Finding]:
    """All that is wrong with a run and with what it left behind."""
    found = [*_of_end(case, outcome), *_of_words(outcome), *_of_changes(case, before, after)]
    if case.workspace is not None:
        found += _of_log(case.workspace)
        if outcome.code in (0, 5):
            found += _of_results(case, outcome, grounds)
    if outcome.code == 0 and case.same_at_once and case.same_as is not None and case.workspace is not None:
        word = "incomplete, yet code 0" if _has_warned(outcome) else "quietly wrong"
        found += [Finding(word, facts) for facts in differences(case.workspace, case.same_as)]
    for check in case.checks:
        facts = check(outcome)
        if facts:
            found.append(Finding("quietly wrong", facts))
    return found


def judge_rerun(case: Case, outcome: Outcome) -> list[Finding]:
    """What is wrong with the run that follows."""
    found = [*_of_words(outcome)]
    if outcome.code != 0:
        found.append(Finding("not mended by a rerun", str(outcome)))
    elif case.workspace is not None and case.same_as is not None:
        found += [Finding("not mended by a rerun", facts) for facts in differences(case.workspace, case.same_as)]
    return found


def differences(workspace: Path, expected: Path) -> list[str]:
    """Maps and files of the cloud that are not as in another workspace, in one sentence if any."""
    found, wanted = result_files(workspace), result_files(expected)
    different = [str(name) for name in sorted(wanted - found)]
    there = sorted(found & wanted)
    different += [str(name) for name in there if not filecmp.cmp(workspace / name, expected / name, shallow=False)]
    return [f"{len(different)} results differ, such as {different[0]}"] if different else []


def _of_end(case: Case, outcome: Outcome) -> Iterator[Finding]:
    if outcome.timed_out:
        yield Finding("hang", str(outcome))
    elif outcome.signal:
        yield Finding("crash", str(outcome))
    elif outcome.code not in case.codes:
        yield Finding("exit code", str(outcome))
    elif outcome.code != 0 and not outcome.stderr.strip():
        yield Finding("no word", str(outcome))
    if outcome.memory > _MEMORY:
        yield Finding("memory", str(outcome))


def _of_words(outcome: Outcome) -> Iterator[Finding]:
    for name, said in (("stderr", outcome.stderr), ("stdout", outcome.stdout)):
        if "Traceback (most recent call last)" in said:
            yield Finding("traceback", f"{name}: {said.strip().splitlines()[-1]}")
        elif "Warning: " in said:
            line = next(line for line in said.splitlines() if "Warning: " in line)
            yield Finding("warning of a library", f"{name}: {line}")
        yield from _of_characters(name, said)


def _of_characters(name: str, said: str) -> Iterator[Finding]:
    control = sorted({letter for letter in said if unicodedata.category(letter) == "Cc"} - {"\n", "\t"})
    if control:
        yield Finding("control characters", f"{name}: {control!r}")


def _of_log(workspace: Path) -> Iterator[Finding]:
    path = workspace / "colmap_sph" / "log.txt"
    if path.is_symlink() or not path.is_file():
        return
    log = path.read_bytes().decode(errors="backslashreplace")
    if "Traceback (most recent call last)" in log:
        yield Finding("traceback in the log", log.strip().splitlines()[-1])
    yield from _of_characters("log.txt", log)


def _of_changes(case: Case, before: Snapshot, after: Snapshot) -> Iterator[Finding]:
    for change in outside(changes(before, after), case.workspace, case.protected):
        if change.path in case.protected and _is_kept(change.path, before, after):
            continue
        word = "user's file lost" if change.path in case.protected else "written outside"
        yield Finding(word, str(change))


def _is_kept(path: Path, before: Snapshot, after: Snapshot) -> bool:
    """Whether a user's file that made place is beside it, under a longer name."""
    content = content_of(before[path])
    beside = (other for other in after if other.parent == path.parent and other.name.startswith(path.name))
    return any(content_of(after[other]) == content for other in beside)


def _of_results(case: Case, outcome: Outcome, grounds: Grounds) -> Iterator[Finding]:
    assert case.workspace is not None
    if not case.whole and _has_warned(outcome):
        return
    for name, truth in case.names.items():
        path = depth_path(case.workspace, name)
        if not path.is_file():
            if outcome.code == 0 and case.whole:
                yield Finding("quietly wrong", f"{name} has no depth map")
            continue
        score = score_of(read_depth(path) / np.float32(case.scale), grounds.truth[case.project, truth])
        clean = grounds.scores[case.project, truth]
        if score.bad > (clean.bad + _WORSE if case.whole else _GARBAGE):
            yield Finding("quietly wrong", f"{name}: {score.bad:.0%} of its depths are wrong")
        elif case.whole and outcome.code == 0 and score.coverage < _EMPTIER * clean.coverage:
            yield Finding("quietly wrong", f"{name}: {score.coverage:.0%} of its pixels have a depth")
    if case.whole and outcome.code == 0 and case.in_place and case.names:
        yield from _of_cloud(case, grounds)


def _has_warned(outcome: Outcome) -> bool:
    return any(word in outcome.stderr for word in ("warning:", "skipped:", "incomplete:", "few points:"))


def _of_cloud(case: Case, grounds: Grounds) -> Iterator[Finding]:
    assert case.workspace is not None
    path = case.workspace / "fused.ply"
    if not path.is_file():
        yield Finding("quietly wrong", "there is no cloud")
        return
    bad = [_share_off(file, case.project, grounds) for file in (path, _clean_cloud(case, grounds))]
    if bad[0] > bad[1] + _WORSE:
        yield Finding("quietly wrong", f"{bad[0]:.0%} of the cloud's points are off")


def _clean_cloud(case: Case, grounds: Grounds) -> Path:
    return grounds.project(case.project) / "dense" / "fused.ply"


def _share_off(cloud: Path, project: str, grounds: Grounds) -> float:
    """Share of a cloud's points that a picture from above sees elsewhere than they are; 1 of an empty one."""
    points = np.column_stack([read_cloud(cloud), np.ones(len(read_cloud(cloud)))])
    column, row, depth = (grounds.looks[project, _MOST_SEEN] @ points.T).astype(np.float64)
    truth = grounds.truth[project, _MOST_SEEN]
    with np.errstate(all="ignore"):
        place = np.rint(np.stack([row / depth, column / depth]))
    inside = (depth > 0) & (place >= 0).all(axis=0) & (place < np.array(truth.shape)[:, None]).all(axis=0)
    if not inside.any():
        return 1.0
    rows, columns = place[:, inside].astype(int)
    seen = truth[rows, columns]
    return float((np.abs(depth[inside] - seen) > 0.02 * seen).mean())


def read_cloud(path: Path) -> NDArray[np.float64]:
    """Points (N, 3) of a fused cloud, by the header of its PLY file."""
    data = path.read_bytes()
    head, _, body = data.partition(b"end_header\n")
    types = {"float": "<f4", "double": "<f8", "uchar": "u1"}
    words = [line.split() for line in head.decode().splitlines()]
    fields = [(line[2], types[line[1]]) for line in words if line[:1] == ["property"]]
    number = next(int(line[2]) for line in words if line[:2] == ["element", "vertex"])
    vertices = np.frombuffer(body, np.dtype(fields), number)
    return np.column_stack([vertices[axis] for axis in "xyz"]).astype(np.float64)
