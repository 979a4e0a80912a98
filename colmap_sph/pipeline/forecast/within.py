"""A time limit → the settings of a run that arrive by then, chosen as it goes.

Estimates alone do not tell how fast a machine is. So a few pairs are timed first; then settings are chosen from a
ladder, pairs are matched in the order of their worth as long as there is time for the rest of the run, and the
rounds of refinement follow from what is left. What is chosen are ordinary options, with which any run makes the
same.
"""

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.contradictions import check_numbers
from colmap_sph.pipeline.forecast.earlier import keep_choice, not_beyond
from colmap_sph.pipeline.forecast.foresight import estimate, estimated_fusion, foreseen_stages
from colmap_sph.pipeline.forecast.ladder import BEST, Choice, Settings, choices
from colmap_sph.pipeline.forecast.ranks import MoreRanksStage, ProbeStage, Progressed, RankStage, ranks_of
from colmap_sph.pipeline.forecast.time_limit import TimeLimit, format_time
from colmap_sph.pipeline.options import RunOptions, num_cores
from colmap_sph.pipeline.stages.confirm import ConfirmStage, confirm_seconds
from colmap_sph.pipeline.stages.match import MatchStage
from colmap_sph.pipeline.stages.stage import Result
from colmap_sph.pipeline.stages.vote import VoteStage, vote_seconds
from colmap_sph.stereo.partners.pairing import Pair, partners_of
from colmap_sph.stereo.partners.pairs import PairSelection

if TYPE_CHECKING:
    from colmap_sph.pipeline.execute import Executor

logger = logging.getLogger(__name__)

# Pairs that are timed, for each worker.
_PROBES = 2
# Processor seconds per megapixel of an image that is read for the first time.
_READ_SECONDS = 0.02
# What is left of the trust in earlier stages' speed with each stage: others may use the machine, too.
_FADING = 0.5
# Share of what is left that further partners may count on: where the rest takes longer, refinement must not pay.
_CAUTION = 0.9
# Pairs that each sampling's estimate rests on.
_ASKED = 8
# Processor seconds of what follows the last stage, the page: of any run, and of each image.
_PAGE_SECONDS = 1.8
_PAGE_SECONDS_EACH = 0.03


def page_seconds(images: int) -> float:
    """Processor seconds to make the page of a run with so many images."""
    return _PAGE_SECONDS + _PAGE_SECONDS_EACH * images


def widest(options: RunOptions, limit: TimeLimit) -> RunOptions:
    """The options with as many partners as a run may come to have."""
    if "pairs.num_pairs" in limit.kept:
        return options
    return replace(options, pairs=replace(options.pairs, num_pairs=BEST.partners))


class Pace:
    """Seconds that an estimated processor second takes on this machine, all workers at work.

    Parameters
    ----------
    workers : int
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._worked = 0.0
        self._taken = 0.0

    def note(self, worked: float, taken: float) -> None:
        """So much work was done in so many seconds, since what was noted before."""
        self._worked = _FADING * self._worked + worked
        self._taken = _FADING * self._taken + taken

    def speed(self, worked: float = 0.0, taken: float = 0.0) -> float:
        """Of all work so far, and of some that is under way; before any, of one second by each worker."""
        done = self._worked + worked
        return (self._taken + taken) / done if done else 1 / self._workers


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
    """

    def __init__(
        self, limit: TimeLimit, context: Context, selection: PairSelection, *, goes_on: bool = True
    ) -> None:
        self._limit = limit
        self._context = context
        self._workers = min(context.options.num_threads, num_cores())
        self._pace = Pace(self._workers)
        self._ranks = ranks_of(selection)
        kept = limit.kept
        if selection.source == "patch-match.cfg":
            kept |= {"pairs.num_pairs"}
        if "pairs.num_pairs" in kept:
            self._ranks = [[pair for rank in self._ranks for pair in rank]]
        self._kept = kept
        ladder = choices(context.options, kept)
        self._ladder = not_beyond(context.workspace, limit.seconds, kept, ladder) if goes_on else ladder
        self._settings = self._ladder[0]
        self._has_pairs = any(context.workspace.pairs_dir.glob("*"))
        self._rank_works: dict[tuple[float, int], float] = {}
        self._later_works: dict[tuple[int, int, int], float] = {}

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
            normals, refinement = (options.normals, options.refinement)
            known = estimated_fusion(self._context).seconds
            for name, others in partners.items():
                seconds = vote_seconds(len(others), normals) + confirm_seconds(len(others), normals, refinement)
                known += seconds * self._context.window(name).num_pixels / 1e6
            self._later_works[case] = known
        return known

    def _work(self, settings: Settings) -> float:
        count = self._count(settings)
        matching = sum(self._rank_work(settings.sampling, rank) for rank in range(count))
        return matching + self._later_work(count, settings)

    def _seconds(self, work: float, speed: float) -> float:
        """Until the end of the run, with so much work before the page."""
        page = page_seconds(len(self._context.scene.views))
        return (work + page * self._workers) * speed

    # ---- what is chosen ------------------------------------------------------------------------------------

    def choose(self) -> Choice:
        """The best settings that there is time for, or else the quickest."""
        speed = self._pace.speed()
        seconds = {settings: self._seconds(self._work(settings), speed) for settings in self._ladder}
        elapsed = self._limit.elapsed  # not before: to estimate takes time, too
        fitting = [settings for settings in self._ladder if elapsed + seconds[settings] <= self._limit.seconds]
        settings = fitting[-1] if fitting else self._ladder[0]
        return Choice(settings, self._limit.seconds, elapsed + seconds[settings])

    def planned(self) -> tuple[Context, list[Pair], Choice]:
        """What a dry run goes on with: nothing is timed."""
        choice = self.choose()
        return self._with(choice.settings), self._pairs(self._count(choice.settings)), choice

    def match(self, executor: "Executor") -> tuple[Context, dict[Pair, Result]]:
        """Choose settings and match pairs; return the context with them and the results.

        Parameters
        ----------
        executor : callable
            Makes the results of a stage, see `Executor`.
        """
        self._time_some_pairs(executor)
        choice = self.choose()
        self._settings = choice.settings
        context = self._with(self._settings)
        count = self._count(self._settings)
        check_numbers(context, self._pairs(count))
        self._keep()
        logger.log(logging.WARNING if choice.is_too_little else logging.INFO, "%s", choice.words)
        context.progress.foresee(foreseen_stages(context, self._pairs(count)))
        results, done = self._match_ranks(RankStage, context, 0, count, executor)
        more = self._affordable(done) if done == count else done
        if more > done:
            foreseen = foreseen_stages(context, self._pairs(more))
            matching = estimate(self._stage(MoreRanksStage, context, done, more))
            context.progress.foresee([matching, *foreseen[1:]])
            others, done = self._match_ranks(MoreRanksStage, context, done, more, executor)
            results |= others
        if "pairs.num_pairs" not in self._kept:
            self._settings = replace(self._settings, partners=done)
        self._settings = replace(self._settings, radius=self._affordable_radius(done))
        pairs = self._pairs(done)
        context.report.pairs = len(results)
        return self._with(self._settings), {pair: results[pair] for pair in pairs if pair in results}

    def _time_some_pairs(self, executor: "Executor") -> None:
        """Measure the speed of this machine."""
        number = min(_PROBES * self._workers, len(self._ranks[0]))
        probes = [self._ranks[0][index * len(self._ranks[0]) // number] for index in range(number)]
        context = self._with(self.choose().settings)
        made = {pair: result for pair, result in executor(ProbeStage(context, probes)).items() if result.made}
        worked = sum(result.seconds for result in made.values())
        for name in {name for pair in made for name in pair}:
            worked += _READ_SECONDS * context.scene.view(name).num_pixels / 1e6
        self._pace.note(worked, sum(result.taken for result in made.values()) / self._workers)
        context.report.skipped_pairs.clear()
        context.report.incomplete.clear()

    def _stage(self, kind: type[RankStage], context: Context, first: int, end: int) -> RankStage:
        return kind(context, self._ranks[first:end], self._may_begin, self._limit.clock, first)

    def _match_ranks(
        self, kind: type[RankStage], context: Context, first: int, end: int, executor: "Executor"
    ) -> tuple[dict[Pair, Result], int]:
        """Match ranks as long as there is time; return the results, and how many ranks are matched in all."""
        stage = self._stage(kind, context, first, end)
        results = executor(stage)
        self._note(stage.name, results)
        return results, stage.done

    def _note(self, stage: str, results: Mapping[Any, Result]) -> None:
        worked = sum(result.seconds for result in results.values() if result.made)
        if worked:
            self._pace.note(worked, self._context.report.seconds[stage])

    def _may_begin(self, rank: int, progress: Progressed) -> bool:
        """Whether there is time to match a rank, and for all that comes after."""
        if rank < self._count(self._ladder[0]):
            return True
        work = progress.underway + self._rank_work(self._settings.sampling, rank)
        work += self._later_work(rank + 1, self._settings_after(rank))
        return self._seconds(work, self._pace.speed(progress.worked, progress.taken)) <= self._limit.left

    def _settings_after(self, rank: int) -> Settings:
        """What to keep time for: refinement and normals bring more than partners beyond those first chosen."""
        if rank < self._count(self._settings):
            return self._settings
        return replace(self._settings, rounds=self._ladder[-1].rounds, radius=self._ladder[-1].radius)

    def _affordable(self, done: int) -> int:
        """How many ranks there is time for in all, so many of which are matched."""
        speed = self._pace.speed()
        matching = 0.0
        for rank in range(done, self._most):
            matching += self._rank_work(self._settings.sampling, rank)
            work = matching + self._later_work(rank + 1, self._settings_after(rank))
            if self._seconds(work, speed) > _CAUTION * self._limit.left:
                return rank
        return self._most

    def _affordable_radius(self, done: int) -> int:
        """The larger radius of normals where there is time for it, too."""
        usual = replace(self._settings, radius=self._ladder[-1].radius)
        seconds = self._seconds(self._later_work(done, usual), self._pace.speed())
        return usual.radius if seconds <= self._limit.left else self._ladder[0].radius

    def refined(self, context: Context, matched: Mapping[Pair, Result], votes: Mapping[str, Result]) -> Context:
        """Choose the rounds of refinement that there is time for; return the context with them.

        Parameters
        ----------
        context : Context
            As `match` returned it.
        matched, votes : mapping
            Results of the stages so far.
        """
        self._note(VoteStage.name, votes)
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
        report.within = f"{format_time(self._limit.seconds)}: {self._settings.flags}"
        logger.info("Within %s; the same again without a limit: %s", report.within, report.command)

    def _has_time_for(self, rounds: int, matched: Mapping[Pair, Result], votes: Mapping[str, Result]) -> bool:
        context = self._with(replace(self._settings, rounds=rounds))
        work = estimate(ConfirmStage(context, matched, votes)).seconds + estimated_fusion(context).seconds
        return self._seconds(work, self._pace.speed()) <= self._limit.left
