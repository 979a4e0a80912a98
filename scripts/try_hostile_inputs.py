"""Try the command on thousands of hostile inputs, and on faults of the machine, and judge what it does.

    python scripts/try_hostile_inputs.py --output /tmp/hostile --cases 2000
    python scripts/try_hostile_inputs.py --output /tmp/hostile --seconds 600 --seed 7 --kind faults
    python scripts/try_hostile_inputs.py --output /tmp/hostile --case 123        # one again

Cases are names of images, links and devices, damaged headers, records, clouds, images, masks, models and settings,
files of the user's in the workspace, and failing file operations (a shim that the system's compiler `cc` makes).
All start from tiny rendered scenes with exact depth. A case has failed where the command prints a traceback,
dies, hangs, writes outside of its workspace, takes the user's files or too much memory, or is wrong without a
word; and where a rerun after a fault does not end with the very bytes of a run left alone. Prints a line for each
failure and a table; what failed lies in OUTPUT/failures, with its command. Exit code 1: something failed.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from hostile import campaign
from hostile.kinds import KINDS, kind_of
from hostile.shim import load_shim

import colmap_sph.app.cli  # noqa: F401  # loaded before any fork

_MOST = 10**7


@dataclass(frozen=True)
class Campaign:
    """Try the command on hostile inputs."""

    output: Path
    """Folder for all of it; what an earlier campaign left there is removed, if it is known as such."""
    seed: int = 0
    """The same seed and number make the same case."""
    cases: int | None = None
    """Number of cases. Default: 2000, or with --seconds as many as fit."""
    seconds: float | None = None
    """No case begins later."""
    kind: str = "all"
    """Only cases of this kind: names, places, headers, records, clouds, pictures, masks, numbers, settings,
    damage, users or faults."""
    case: int | None = None
    """Only the case of this number."""
    processes: int = 2
    """Cases at a time."""

    def numbers(self) -> tuple[int, ...]:
        """Numbers of the cases that are meant."""
        if self.case is not None:
            return (self.case,)
        most = self.cases or (_MOST if self.seconds is not None else 2000)
        found: list[int] = []
        number = 0
        while len(found) < min(most, _MOST // 100):
            if self.kind in ("all", kind_of(number)):
                found.append(number)
            number += 1
        return tuple(found)


def main(wanted: Campaign) -> int:
    """Try, print, return the exit code."""
    if wanted.kind not in ("all", *KINDS):
        sys.exit(f"error: --kind {wanted.kind}: choose one of {', '.join(KINDS)}.")
    library = load_shim(wanted.output)
    plan = campaign.Plan(
        wanted.output.resolve(), wanted.seed, wanted.numbers(), wanted.seconds or 1e9, wanted.processes
    )
    grounds = campaign.prepare(plan.output)
    results = []
    for result in campaign.carry_out(plan, grounds, library):
        results.append(result)
        if result.verdicts:
            print(f"{result.number} {result.kind}: {result.what!a}", flush=True)
            for words in result.facts:
                print(f"    {', '.join(result.verdicts)}: {words!a}", flush=True)
    print(f"\n{campaign.table(results)}\n")
    failed = [result for result in results if result.verdicts]
    print(f"seed {plan.seed}: {len(results)} cases, {len(failed)} failed")
    if failed:
        print(f"again: {Path(sys.argv[0]).name} --output FOLDER --seed {plan.seed} --case {failed[0].number}")
    return int(bool(failed) or not results)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Campaign)))
