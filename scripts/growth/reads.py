"""How often the maps of each view are read while a block is checked or fused, for some cache: simulated."""

from collections.abc import Iterable, Mapping, Sequence

from colmap_sph.pipeline.load_cache import LoadCache
from colmap_sph.scene import Scene
from colmap_sph.stereo.partners.pairing import partners_of
from colmap_sph.stereo.partners.pairs import Overlap, PairOptions, select_pairs
from colmap_sph.stereo.partners.places import Places
from colmap_sph.stereo.partners.reads import best_order

# Bytes per pixel in memory: of the packed maps of a view with its image, and of an estimate with the grey image.
_FUSED_BYTES = 16
_CHECKED_BYTES = 10
_PARTNERS = 50


def reads_in_fusion(scene: Scene, pixels: float, memory: float) -> tuple[float, float]:
    """Reads of each view's maps, in the order of place and in that of names."""
    overlap = Overlap(scene)
    partners = {name: overlap.of(name, _PARTNERS) for name in scene.index_of}
    return _in_both_orders(scene, partners, _FUSED_BYTES * pixels, memory, knows_future=True)


def reads_in_check(scene: Scene, pixels: float, memory: float) -> tuple[float, float]:
    """Reads of each view's estimate, in the order of place and in that of names."""
    partners = partners_of(select_pairs(scene, PairOptions()).unique_pairs())
    return _in_both_orders(scene, partners, _CHECKED_BYTES * pixels, memory, knows_future=False)


def _in_both_orders(
    scene: Scene, partners: Mapping[str, Sequence[str]], size: float, memory: float, *, knows_future: bool
) -> tuple[float, float]:
    names = list(scene.index_of)
    places = Places(scene)
    in_place: Sequence[str] = places.sorted(names)
    if knows_future:
        in_place = best_order((in_place, *places.in_strips(names)), partners, dict.fromkeys(names, size), memory)
    return (
        _reads(in_place, partners, size, memory, knows_future=knows_future) / len(names),
        _reads(names, partners, size, memory, knows_future=False) / len(names),
    )


def _reads(
    order: Iterable[str], partners: Mapping[str, Sequence[str]], size: float, memory: float, *, knows_future: bool
) -> int:
    """Times that something is loaded, by the cache that the program has."""
    asked = [(number, name) for number, item in enumerate(order) for name in [item, *partners.get(item, [])]]
    needed = [0.0] * len(asked)
    if knows_future:
        next_of: dict[str, float] = {}
        for place, (number, name) in reversed(list(enumerate(asked))):
            needed[place] = next_of.get(name, float("inf"))
            next_of[name] = float(number)
    loads = 0

    def load() -> bool:
        nonlocal loads
        loads += 1
        return True

    cache: LoadCache[bool] = LoadCache(lambda _: int(size))
    with cache.holding(int(memory)):
        for (_, name), when in zip(asked, needed, strict=True):
            cache.get(name, load, when)
    return loads
