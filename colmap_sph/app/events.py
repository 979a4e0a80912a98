"""What happens in a run, for programs: a line of JSON on the standard output for each event.

docs/usage.md describes every field. Fields may be added; one that is there keeps its name and meaning as long as
`SCHEMA` stays.
"""

import json
import logging
import threading
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO

import colmap_sph
from colmap_sph.app.standard_streams import silence
from colmap_sph.errors import reason_of
from colmap_sph.pipeline.forecast.time_left import TimeLeft
from colmap_sph.pipeline.plan import Plan
from colmap_sph.pipeline.report import Left, RunReport, StageEstimate

logger = logging.getLogger(__name__)

SCHEMA = 1
_SECONDS = 1.0
"""Steps are told no more often than this; the last one of a stage always is."""


class Events:
    """Writes events; is the `Progress` of a run.

    Parameters
    ----------
    stream : text stream or None
        The standard output; None: nobody wants events.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self._time_left = TimeLeft(1)
        self._lock = threading.Lock()
        self._began = time.monotonic()
        self._stage = ""
        self._stage_began = self._began
        self._total = 0
        self._done = 0
        self._told = 0.0
        self._is_ended = False
        self._results: dict[str, Any] = {}

    def begin(self, arguments: Sequence[str], workspace: Path | None, workers: int) -> None:
        """First event: which command begins, in which workspace, by how many workers."""
        self._time_left = TimeLeft(workers)
        self._write(
            "begin",
            schema=SCHEMA,
            version=colmap_sph.__version__,
            time=datetime.now(UTC).isoformat(timespec="seconds"),
            arguments=list(arguments),
            workspace=None if workspace is None else str(workspace.absolute()),
        )

    def plan(self, plan: Plan) -> None:
        """What a dry run found."""
        names = ("undistort", "pairs", "pairs_done", "images", "images_done", "fuse", "free_disk")
        self._write(
            "plan",
            **{name: getattr(plan, name) for name in names},
            seconds_left=round(plan.seconds, 1),
            choice=plan.choice,
            memory=round(plan.memory),
            disk=round(plan.disk),
        )

    def engage(self, threads: int, words: str) -> None:
        """See `Progress`."""
        self._time_left.engage(threads, words)
        self._write("cluster", threads=threads, words=words)

    def foresee(self, stages: Sequence[StageEstimate]) -> None:
        """See `Progress`."""
        self._time_left.foresee(stages)

    def start(self, stage: str, total: int) -> None:
        """See `Progress`."""
        self._end_stage()
        self._time_left.start(stage, total)
        self._stage = stage
        self._stage_began = time.monotonic()
        self._total = total
        self._done = 0
        self._told = self._stage_began
        self._write("stage", stage=stage, total=total, seconds_left=self._left())

    def advance(self, seconds: float = 0.0) -> None:
        """See `Progress`."""
        self._time_left.advance(seconds)
        self._done += 1
        now = time.monotonic()
        if self._done == self._total or now - self._told >= _SECONDS:
            self._told = now
            self._write(
                "progress", stage=self._stage, done=self._done, total=self._total, seconds_left=self._left()
            )

    def leave_out(self, what: Left, name: str, reason: str) -> None:
        """See `Progress`."""
        self._write("left_out", what=what, name=name, reason=reason)

    def note(self, report: RunReport) -> None:
        """Keep what the last event tells of a run that has come to its end."""
        coverage = sum(report.coverage.values()) / max(len(report.coverage), 1)
        self._results = {
            "images": report.images,
            "pairs": report.pairs,
            "points": report.points,
            "coverage": round(coverage, 4),
        }

    def end(self, exit_code: int, error: str = "") -> None:
        """Last event: how the command ended."""
        self._end_stage()
        self._write("end", exit_code=exit_code, error=error, **self._results)
        self._is_ended = True

    def _end_stage(self) -> None:
        if self._stage:
            taken = round(time.monotonic() - self._stage_began, 3)
            self._write("stage_end", stage=self._stage, done=self._done, total=self._total, seconds_taken=taken)
        self._stage = ""

    def _left(self) -> float | None:
        left = self._time_left.seconds()
        return None if left is None else round(left, 1)

    def _write(self, event: str, **fields: object) -> None:
        with self._lock:
            if self._stream is None or self._is_ended:
                return
            line = {"event": event, "seconds": round(time.monotonic() - self._began, 3), **fields}
            try:
                self._stream.write(json.dumps(line) + "\n")
                self._stream.flush()
            except OSError as error:
                # A run of hours does not end because nobody listens any more.
                self._is_ended = True
                silence(1)
                logger.warning("The standard output cannot be written (%s): no more events", reason_of(error))
