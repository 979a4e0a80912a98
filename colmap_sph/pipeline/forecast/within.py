"""A time limit → the settings of a run that arrive by then, chosen as it goes.

Estimates alone do not tell how fast a machine is. So a few pairs are timed first; then settings are chosen from a
ladder, pairs are matched in the order of their worth as long as there is time for the rest of the run, and the
rounds of refinement follow from what is left. What is chosen are ordinary options, with which any run makes the
same.
"""

import logging
from collections.abc import Mapping
from dataclasses import replace
from statistics import median
from typing import TYPE_CHECKING, Any

from colmap_sph.pipeline.checks.contradictions import check_numbers
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.forecast.earlier import keep_choice, not_beyond
from colmap_sph.pipeline.forecast.foresight import estimate, estimated_fusion, foreseen_stages
from colmap_sph.pipeline.forecast.ladder import BEST, Choice, Settings, choices
from colmap_sph.pipeline.forecast.pace import Pace
from colmap_sph.pipeline.forecast.ranks import MoreRanksStage, ProbeStage, Progressed, RankStage, ranks_of
from colmap_sph.pipeline.forecast.time_limit import SIZE, TimeLimit, format_time
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.stages.confirm import ConfirmStage, confirm_seconds
from colmap_sph.pipeline.stages.match import MatchStage
from colmap_sph.pipeline.stages.stage import Result, Stage
from colmap_sph.pipeline.stages.vote import VoteStage, normals_seconds, vote_seconds
from colmap_sph.scene import View
from colmap_sph.stereo.partners.pairing import Pair, partners_of
from colmap_sph.stereo.partners.pairs import PairSelection
from colmap_sph.stereo.poses.ties import filled_residuals
from colmap_sph.stereo.refinement import suits_half_size

if TYPE_CHECKING:
    from colmap_sph.pipeline.execute import Executor

logger = logging.getLogger(__name__)

# Pairs that are timed at once, for each worker; and again, as the first are slower, until so much of the time is
# gone, but not more often than so.
_PROBES = 2
_PROBE_SHARE = 0.03
_MOST_PROBES = 4
# Processor seconds per megapixel of an image that is read for the first time.
_READ_SECONDS = 0.02
# Share of what is left that further partners may count on: where the rest takes longer, refinement must not pay.
_CAUTION = 0.95
# Pairs that each sampling's estimate rests on.
_ASKED = 8
# Processor seconds of what follows the last stage, the page: of any run, and of each image.
_PAGE_SECONDS = 1.8
_PAGE_SECONDS_EACH = 0.03
START_SECONDS = 2.0
"""Of what comes before the first stage, of any run: the program and its libraries are loaded."""


def page_seconds(images: int) -> float:
    """Processor seconds to make the page of a run with so many images."""
    return _PAGE_SECONDS + _PAGE_SECONDS_EACH * images


def widest(options: RunOptions, limit: TimeLimit) -> RunOptions:
    """The options with as many partners as a run may come to have."""
    if "pairs.num_pairs" in limit.kept:
        return options
    return replace(options, pairs=replace(options.pairs, num_pairs=BEST.partners))


class Within:
    """Chooses the settings of one run.

    Parameters
    ----------
    limit : TimeLimit
    context : Context
        With as many partners in its options as there may be, see `widest`.
    selection : PairSelection
        With these.
    goes_on : bool
        Whether what an earlier run in this workspace chose counts.
    speed : float, optional
        First guess of the seconds that an estimated processor second takes; else one, divided by the workers.
    """

    def __init__(
        self,
        limit: TimeLimit,
        context: Context,
        selection: PairSelection,
        *,
        goes_on: bool = True,
        speed: float | None = None,
    ) -> None:
        self._limit = limit
        self._context = context
        self._workers = context.options.num_busy
        self._pace = Pace(1 / self._workers if speed is None else speed)
        self._later_pace = Pace(1 / self._workers)
        self._ranks = ranks_of(selection)
        kept = limit.kept
        if selection.source == "patch-match.cfg":
            kept |= {"pairs.num_pairs"}
        if "pairs.num_pairs" in kept:
            self._ranks = [[pair for rank in self._ranks for pair in rank]]
        self._kept = kept
        size = context.options.undistortion.max_image_size
        self._reduced_to = None if SIZE in kept or size == -1 else size
        ladder = choices(context.options, kept)
        self._ladder = not_beyond(context.workspace, limit.seconds, kept, ladder) if goes_on else ladder
        self._settings = self._chosen = self._ladder[0]
        self._done = 0
        self._has_pairs = any(context.workspace.pairs_dir.glob("*"))
        self._rank_works: dict[tuple[float, int], float] = {}
        self._later_works: dict[tuple[int, int, int], float] = {}
        self._residuals: dict[Pair, float | None] = {}
        self._residual: float | None = None

    # ---- what settings take --------------------------------------------------------------------------------

    def _with(self, settings: Settings) -> Context:
        options = settings.applied(self._context.options)
        return replace(self._context, options=options, keys=self._context.keys.of(options))

    def _count(self, settings: Settings) -> int:
        """Ranks of pairs that are matched."""
        return 1 if "pairs.num_pairs" in self._kept else min(settings.partners, len(self._ranks))

    @property
    def _most(self) -> int:
        """Ranks that may be matched at most."""
        return max(map(self._count, self._ladder))

    def _pairs(self, count: int) -> list[Pair]:
        return sorted(pair for rank in self._ranks[:count] for pair in rank)

    def _rank_work(self, sampling: float, rank: int) -> float:
        """Estimated processor seconds to match what is not there of a rank."""
        asked = rank if self._has_pairs else -1  # where nothing is there, pairs of all ranks are alike
        known = self._rank_works.get((sampling, asked))
        if known is None:
            pairs = self._ranks[rank] if self._has_pairs else self._pairs(len(self._ranks))
            context = self._with(replace(self._ladder[0], sampling=sampling))
            known = estimate(MatchStage(context, pairs), _ASKED).seconds / max(len(pairs), 1)
            self._rank_works[sampling, asked] = known
        return known * len(self._ranks[rank])

    def _later_work(self, count: int, settings: Settings) -> float:
        """Of all stages after the matching of so many ranks."""
        case = (count, settings.rounds, settings.radius)
        known = self._later_works.get(case)
        if known is None:
            partners = partners_of(self._pairs(count))
            options = settings.applied(self._context.options)
            known = estimated_fusion(self._context).seconds
            for name, others in partners.items():
                seconds = vote_seconds(len(others))
                seconds += normals_seconds(options.normals) if self._context.wants_photometric else 0.0
                for view in self._context.scene.photograph(name).views:
                    pixels = self._context.window(view.name).num_pixels
                    known += (seconds + self._confirm_seconds(view, len(others), options)) * pixels / 1e6
            self._later_works[case] = known
        return known

    def _confirm_seconds(self, view: View, partners: int, options: RunOptions) -> float:
        """Processor seconds per megapixel to confirm a view and to refine it, by what is known of its pairs."""
        if self._residual is None:
            return confirm_seconds(partners, options.normals, options.refinement)
        residual = self._residual * float(view.K[0, 0])
        return confirm_seconds(
            partners,
            options.normals,
            options.refinement.for_residual(residual),
            half_size=suits_half_size(self._context.details.get(view.name, 1.0), residual),
        )

    def _note_residuals(self, results: Mapping[Pair, Result]) -> None:
        """Views with precise poses take less refinement, and so do soft ones with imprecise poses."""
        self._residuals |= {pair: result.facts.row_residual for pair, result in results.items()}
        if self._residuals:
            self._residual = median(filled_residuals([*self._residuals.values()]))
            self._later_works.clear()

    def _matching_work(self, settings: Settings, first: int, end: int) -> float:
        return sum(self._rank_work(settings.sampling, rank) for rank in range(first, end))

    def _seconds(self, matching: float, later: float, speed: float | None = None) -> float:
        """Until the end of the run, with so much work to match and for what comes after that.

        Parameters
        ----------
        matching, later : float
            Estimated processor seconds.
        speed : float, optional
            Of the matching, where more is known of it than its pace. Before any vote, all else goes like it.
        """
        speed = self._pace.speed() if speed is None else speed
        later_speed = self._later_pace.speed() if self._later_pace.is_known else speed
        page = page_seconds(len(self._context.scene.views))
        return matching * speed + (later + page * self._workers) * later_speed

    # ---- what is chosen ------------------------------------------------------------------------------------

    def choose(self) -> Choice:
        """The best settings that there is time for, or else the quickest."""
        seconds = {settings: self._whole_seconds(settings) for settings in self._ladder}
        elapsed = self._limit.elapsed  # not before: to estimate takes time, too
        fitting = [settings for settings in self._ladder if elapsed + seconds[settings] <= self._limit.seconds]
        settings = fitting[-1] if fitting else self._ladder[0]
        return Choice(settings, self._limit.seconds, elapsed + seconds[settings], self._reduced_to is not None)

    def _whole_seconds(self, settings: Settings) -> float:
        count = self._count(settings)
        return self._seconds(self._matching_work(settings, 0, count), self._later_work(count, settings))

    def has_time_for(self, step: int) -> bool:
        """Whether there is time for the settings of a step of the ladder; beyond its end, for the last."""
        return self._whole_seconds(self._ladder[min(step, len(self._ladder) - 1)]) <= self._limit.left

    def planned(self) -> tuple[Context, list[Pair], Choice]:
        """What a dry run goes on with: nothing is timed."""
        choice = self.choose()
        return self._with(choice.settings), self._pairs(self._count(choice.settings)), choice

    def match_and_vote(self, executor: "Executor") -> tuple[Context, dict[Pair, Result], dict[str, Result]]:
        """Choose settings, match pairs and let them vote.

        Parameters
        ----------
        executor : callable
            Makes the results of a stage, see `Executor`.

        Returns
        -------
        context : Context
            With the settings.
        matched, votes : mapping
            Results of both stages.
        """
        self._time_some_pairs(executor)
        choice = self.choose()
        self._settings = self._chosen = choice.settings
        count = self._count(self._settings)
        context = self._with(self._settings)
        check_numbers(context, self._pairs(count))
        self._keep()
        logger.log(logging.WARNING if choice.is_too_little else logging.INFO, "%s", choice.words)
        context.progress.foresee(foreseen_stages(context, self._pairs(count)))
        matched = self._match(RankStage, count, executor)
        if self._done == count:
            matched |= self._match_more(executor)
        self._settings = replace(self._settings, radius=self._affordable_radius())
        votes = self._vote(executor, matched)
        # Only now is it known what takes the rest of the time, and where it is less than was thought, …
        while self._is_improved(executor, matched):
            votes = self._vote(executor, matched)  # … voting anew takes little of it.
        return self._with(self._settings), self._of_ranks(matched), votes

    def _time_some_pairs(self, executor: "Executor") -> None:
        """Measure the speed of this machine."""
        number = min(_MOST_PROBES * _PROBES * self._workers, len(self._ranks[0]))
        probes = [self._ranks[0][index * len(self._ranks[0]) // number] for index in range(number)]
        context = self._with(self.choose().settings)
        started = self._limit.elapsed
        seen: set[str] = set()
        for first in range(_MOST_PROBES):
            results = executor(ProbeStage(context, probes[first::_MOST_PROBES]))
            self._note_residuals(results)
            made = {pair: result for pair, result in results.items() if result.made}
            worked = sum(result.seconds for result in made.values())
            for name in {name for pair in made for name in pair} - seen:
                worked += _READ_SECONDS * context.scene.view(name).num_pixels / 1e6
                seen.add(name)
            self._pace.note(worked, sum(result.taken for result in made.values()) / self._workers)
            if self._limit.elapsed - started >= _PROBE_SHARE * self._limit.seconds:
                break
        context.report.skipped_pairs.clear()
        context.report.incomplete.clear()

    def _stage(self, kind: type[RankStage], end: int) -> RankStage:
        ranks = self._ranks[self._done : end]
        return kind(self._with(self._settings), ranks, self._may_begin, self._limit.clock, self._done)

    def _match(self, kind: type[RankStage], end: int, executor: "Executor") -> dict[Pair, Result]:
        """Match ranks as long as there is time."""
        stage = self._stage(kind, end)
        results = self._timed(executor, stage, self._pace)
        self._note_residuals(results)
        self._done = stage.done
        if "pairs.num_pairs" not in self._kept:
            self._settings = replace(self._settings, partners=self._done)
        return results

    def _match_more(self, executor: "Executor") -> dict[Pair, Result]:
        """Match the further ranks that there is time for."""
        end = self._affordable()
        if end == self._done:
            return {}
        foreseen = foreseen_stages(self._with(self._settings), self._pairs(end))
        self._context.progress.foresee([estimate(self._stage(MoreRanksStage, end)), *foreseen[1:]])
        return self._match(MoreRanksStage, end, executor)

    def _is_improved(self, executor: "Executor", matched: dict[Pair, Result]) -> bool:
        """Whether there was time for better settings after a vote; `matched` gets what that took."""
        before = self._settings
        matched |= self._match_more(executor)
        self._settings = replace(self._settings, radius=max(before.radius, self._affordable_radius()))
        return self._settings != before

    def _vote(self, executor: "Executor", matched: Mapping[Pair, Result]) -> dict[str, Result]:
        self._context.report.pairs = len(matched)
        return self._timed(
            executor, VoteStage(self._with(self._settings), self._of_ranks(matched)), self._later_pace
        )

    def _of_ranks(self, matched: Mapping[Pair, Result]) -> dict[Pair, Result]:
        return {pair: matched[pair] for pair in self._pairs(self._done) if pair in matched}

    def _timed(self, executor: "Executor", stage: Stage[Any, Any], pace: Pace) -> dict[Any, Result]:
        started = self._limit.elapsed
        results = executor(stage)
        worked = sum(result.seconds for result in results.values() if result.made)
        if worked:
            pace.note(worked, self._limit.elapsed - started)
        return results

    def _may_begin(self, rank: int, progress: Progressed) -> bool:
        """Whether there is time to match a rank, and for all that comes after."""
        if rank < self._count(self._ladder[0]):
            return True
        matching = progress.underway + self._rank_work(self._settings.sampling, rank)
        later = self._later_work(rank + 1, self._settings_after(rank))
        speed = self._pace.speed(progress.worked, progress.taken)
        return self._seconds(matching, later, speed) <= self._limit.left

    def _settings_after(self, rank: int) -> Settings:
        """What to keep time for: refinement and normals bring more than partners beyond those first chosen."""
        if rank < self._count(self._chosen):
            return replace(self._settings, rounds=self._chosen.rounds)
        return replace(self._settings, rounds=self._ladder[-1].rounds, radius=self._ladder[-1].radius)

    def _affordable(self) -> int:
        """How many ranks there is time for in all."""
        for rank in range(self._done, self._most):
            matching = self._matching_work(self._settings, self._done, rank + 1)
            later = self._later_work(rank + 1, self._settings_after(rank))
            if self._seconds(matching, later) > _CAUTION * self._limit.left:
                return rank
        return self._most

    def _affordable_radius(self) -> int:
        """The larger radius of normals where there is time for it, too."""
        usual = replace(self._settings, radius=self._ladder[-1].radius)
        seconds = self._seconds(0.0, self._later_work(self._done, usual))
        return usual.radius if seconds <= self._limit.left else self._ladder[0].radius

    def refined(self, context: Context, matched: Mapping[Pair, Result], votes: Mapping[str, Result]) -> Context:
        """Choose the rounds of refinement that there is time for; return the context with them.

        Parameters
        ----------
        context : Context
        matched, votes : mapping
            As `match_and_vote` returned them.
        """
        if "refinement.rounds" not in self._kept:
            rounds = self._ladder[-1].rounds
            while rounds and not self._has_time_for(rounds, matched, votes):
                rounds -= 1
            self._settings = replace(self._settings, rounds=rounds)
            context = self._with(self._settings)
        self._keep()
        self._report(context)
        return context

    def _keep(self) -> None:
        keep_choice(self._context.workspace, self._limit.seconds, self._kept, self._settings)

    def _report(self, context: Context) -> None:
        """Tell what was chosen in the end, and how to do the same without a limit."""
        report = context.report
        report.command = " ".join([report.command, *self._settings.words(self._limit.kept)])
        if report.sampling is not None:
            usual = self._context.options.rectification.sampling
            report.sampling = round(report.sampling * context.options.rectification.sampling / usual, 3)
        reduced = "" if self._reduced_to is None else f"--max-image-size {self._reduced_to} "
        report.within = f"{format_time(self._limit.seconds)}: {reduced}{self._settings.flags}"
        logger.info("Within %s; the same again without a limit: %s", report.within, report.command)

    def _has_time_for(self, rounds: int, matched: Mapping[Pair, Result], votes: Mapping[str, Result]) -> bool:
        context = self._with(replace(self._settings, rounds=rounds))
        work = estimate(ConfirmStage(context, matched, votes)).seconds + estimated_fusion(context).seconds
        return self._seconds(0.0, work) <= self._limit.left
