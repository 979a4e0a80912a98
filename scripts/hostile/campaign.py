"""Cases by the thousand, in a few processes, until their number or the time is used up; a table of verdicts."""

import json
import os
import shlex
import shutil
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np

from hostile.cases import Case, Stage
from hostile.faults import SCENARIOS, count_operations
from hostile.grounds import Grounds, make_grounds
from hostile.kinds import KINDS, kind_of
from hostile.runs import Outcome, Surroundings, apart, command_line, end_group, run
from hostile.shim import CONTROL_VARIABLE, Control
from hostile.verdicts import Finding, judge, judge_rerun
from hostile.watch import snapshot

_TYPED_SHARE = 0.05
# What fits into a line that a pipe takes in one piece.
_WORDS = 700


@dataclass(frozen=True)
class Plan:
    """Which cases, and where.

    Attributes
    ----------
    output : Path
        Folder for grounds, worlds and what failed.
    seed : int
    numbers : tuple of int
        Of the cases.
    seconds : float
        No case begins later.
    processes : int
    """

    output: Path
    seed: int
    numbers: tuple[int, ...]
    seconds: float
    processes: int


@dataclass(frozen=True)
class Result:
    """What came of a case: its number, kind and words, the verdicts, and facts of the first."""

    number: int
    kind: str
    what: str
    code: int | None
    verdicts: tuple[str, ...]
    facts: tuple[str, ...]
    seconds: float


def prepare(output: Path) -> Grounds:
    """Render and reconstruct what all cases start from."""
    grounds = make_grounds(output / "grounds")
    for name in SCENARIOS:
        world = output / "counting" / "world"
        world.mkdir(parents=True)
        count_operations(Stage(np.random.default_rng(0), grounds, world), name, world.parent)
        shutil.rmtree(world.parent)
    return grounds


def carry_out(plan: Plan, grounds: Grounds, library: Path) -> Iterator[Result]:
    """Try all cases of a plan, in several processes; results as they come."""
    deadline = time.monotonic() + plan.seconds
    receiver, sender = os.pipe()
    sys.stdout.flush()
    workers = []
    for worker in range(plan.processes):
        process = os.fork()
        if process == 0:
            os.close(receiver)
            _work(plan, worker, grounds, library, deadline, sender)
        workers.append(process)
    os.close(sender)
    with os.fdopen(receiver) as lines:
        for line in lines:
            yield Result(**json.loads(line))
    for process in workers:
        os.waitpid(process, 0)


def _work(plan: Plan, worker: int, grounds: Grounds, library: Path, deadline: float, sender: int) -> None:
    try:
        for number in plan.numbers[worker :: plan.processes]:
            if time.monotonic() > deadline:
                break
            result = try_case(plan, number, grounds, library)
            os.write(sender, (json.dumps(asdict(result)) + "\n").encode())
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(0)


def try_case(plan: Plan, number: int, grounds: Grounds, library: Path) -> Result:
    """Set up a case, run it, judge; what failed is set up again below ``failures``, to be looked at."""
    folder = plan.output / "worlds" / str(number)
    start = time.monotonic()
    kind = kind_of(number)
    case, outcome, findings = None, None, [Finding("the harness itself", "the case could not be set up")]
    try:
        case = set_up(plan.seed, number, grounds, folder)
        outcome, findings = _run_and_judge(case, _is_typed(plan.seed, number), grounds, folder)
    except (RuntimeError, OSError) as error:
        findings = [Finding("the harness itself", f"{error!r}")]
    if findings:
        _keep(plan, number, grounds, library, findings, outcome)
    shutil.rmtree(folder, ignore_errors=True)
    return Result(
        number,
        kind,
        "" if case is None else case.what[:_WORDS],
        None if outcome is None else outcome.code,
        tuple(dict.fromkeys(finding.verdict for finding in findings)),
        tuple(finding.facts[:_WORDS] for finding in findings[:3]),
        round(time.monotonic() - start, 2),
    )


def set_up(seed: int, number: int, grounds: Grounds, folder: Path) -> Case:
    """Make the world of a case in a new folder; the same seed and number make the same world."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "world").mkdir(parents=True)
    (folder / "run").mkdir()
    stage = Stage(np.random.default_rng([seed, number]), grounds, folder / "world")
    return apart(partial(KINDS[kind_of(number)], stage))


def _is_typed(seed: int, number: int) -> bool:
    return bool(np.random.default_rng([seed, number, 1]).random() < _TYPED_SHARE)


def _run_and_judge(case: Case, typed: bool, grounds: Grounds, folder: Path) -> tuple[Outcome, list[Finding]]:
    world = folder / "world"
    control = None if case.fault is None else Control(folder / "control", world, case.fault)
    typed = typed and not case.as_user
    around = Surroundings(folder / "run", typed=typed, control=control, as_user=case.as_user)
    before = snapshot(world)
    outcome = run(list(case.arguments), around)
    end_group(around)
    after = snapshot(world)
    findings = apart(partial(judge, case, outcome, grounds, before, after))
    findings += _litter(around.folder)
    if case.again:
        findings += _run_again(case, grounds, around.folder)
    return outcome, findings


def _run_again(case: Case, grounds: Grounds, folder: Path) -> list[Finding]:
    """Run without a fault until all is mended."""
    findings: list[Finding] = []
    for _ in range(case.attempts):
        outcome = run(list(case.again), Surroundings(folder))
        findings = apart(partial(judge_rerun, case, outcome))
        if not findings:
            break
    return findings


def _litter(folder: Path) -> list[Finding]:
    """What a run has left in the current folder, in its home, or among temporary files."""
    left = [path for name in ("cwd", "home", "tmp") for path in (folder / name).iterdir()]
    return [Finding("written outside", f"{left[0].relative_to(folder)} was left behind")] if left else []


def _keep(
    plan: Plan, number: int, grounds: Grounds, library: Path, findings: list[Finding], outcome: Outcome | None
) -> None:
    folder = plan.output / "failures" / f"{number}-{kind_of(number)}"
    try:
        case = set_up(plan.seed, number, grounds, folder)
    except (RuntimeError, OSError):
        return
    variables = ""
    if case.fault is not None:
        control = Control(folder / "control", folder / "world", case.fault)
        variables = f"{CONTROL_VARIABLE}={control.path} LD_PRELOAD={library} "
    lines = [
        "# " + case.what.encode("unicode_escape").decode(),
        *("# " + f"{finding.verdict}: {finding.facts}".encode("unicode_escape").decode() for finding in findings),
        variables + shlex.join(command_line(list(case.arguments))),
        *([shlex.join(command_line(list(case.again)))] if case.again else []),
    ]
    (folder / "command.sh").write_text("\n".join(lines) + "\n", encoding="utf-8", errors="surrogateescape")
    if outcome is not None:
        (folder / "stderr.txt").write_text(outcome.stderr, encoding="utf-8", errors="surrogateescape")


def table(results: Iterable[Result]) -> str:
    """Kinds by verdicts: how many cases of each kind, how many had none to be blamed for, and the others."""
    results = list(results)
    words = sorted({verdict for result in results for verdict in result.verdicts})
    rows = [["kind", "cases", "held", *words]]
    for kind in (*KINDS, "all"):
        mine = [result for result in results if kind in (result.kind, "all")]
        counts = Counter(verdict for result in mine for verdict in result.verdicts)
        held = sum(not result.verdicts for result in mine)
        if mine:
            rows.append([kind, str(len(mine)), str(held), *(str(counts[word] or "-") for word in words)])
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if n else cell.ljust(width)
            for n, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    )
