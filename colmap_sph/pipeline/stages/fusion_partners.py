"""The images in which each image to fuse is looked up, and the stations that they belong to."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from colmap_sph.stereo.fusion import MAX_PARTNERS
from colmap_sph.stereo.partners.pairing import Pair, as_pair, partners_of
from colmap_sph.stereo.partners.pairs import Overlap
from colmap_sph.stereo.partners.stations import OWN_STATION, Stations, by_station

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context

# Images that share most points are looked at for those of different stations, as often as images to fuse.
_CANDIDATES = 4


class PartnersInFusion(Mapping[str, tuple[list[str], list[int]]]):
    """For each image to fuse the others that may see the same: those that share most points, and its pairs'.

    With them come the numbers of their stations, which ascend. Both are found when they are asked for, by any
    thread, and kept.

    Parameters
    ----------
    context : Context
    pairs : iterable of pair
        That were matched: one that the user asked for may share no point.
    names : sequence of str
        Images to fuse.
    """

    def __init__(self, context: "Context", pairs: Iterable[Pair], names: Sequence[str]) -> None:
        self._most = min(context.options.fusion.check_num_images, MAX_PARTNERS)
        self._stations = context.stations
        self._facing = context.facing
        self._overlap = Overlap(context.scene)
        leads = dict.fromkeys((context.lead(first), context.lead(second)) for first, second in pairs)
        self._matched = partners_of(dict.fromkeys(as_pair(*lead) for lead in leads))
        self._lead = context.lead
        self._names = dict.fromkeys(names)
        self._found: dict[str, tuple[list[str], list[int]]] = {}

    def __getitem__(self, name: str) -> tuple[list[str], list[int]]:
        if name not in self._found:
            self._found[name] = self._find(name)
        return self._found[name]

    def _find(self, name: str) -> tuple[list[str], list[int]]:
        overlapping = self._overlap.of(name, _CANDIDATES * self._most)
        matched = self._matched.get(self._lead(name), [])
        firsts = list(dict.fromkeys([*overlapping, *matched]))
        facing = zip(firsts, self._facing.views(name, firsts), strict=True)
        views = {first: [view for view in shown if view in self._names] for first, shown in facing}
        others = [first for first, fused in views.items() if fused]
        chosen = zip(*_some_of_each_station(self._stations, name, others, self._most), strict=True)
        names = [(view, number) for first, number in chosen for view in views[first]][:MAX_PARTNERS]
        return [view for view, _ in names], [number for _, number in names]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _some_of_each_station(
    stations: Stations, name: str, others: list[str], most: int
) -> tuple[list[str], list[int]]:
    """At most so many images, the first of each station before the rest, in the order of their stations."""
    numbers = stations.numbers(name, others)
    firsts = {number: k for k, number in reversed(list(enumerate(numbers))) if number != OWN_STATION}
    chosen = list(dict.fromkeys([*sorted(firsts.values()), *range(len(others))]))[:most]
    return by_station([others[k] for k in sorted(chosen)], [numbers[k] for k in sorted(chosen)])
