"""The demo's scene: a village of some thirty houses on hilly ground, with roads, cars and trees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_sph.synthetic.ground import Plot, Road, paint_ground
from colmap_sph.synthetic.primitives import ConvexPolyhedron, Ellipsoid, FloatArray, Surface
from colmap_sph.synthetic.solids import box, gabled_house
from colmap_sph.synthetic.terrain import Terrain
from colmap_sph.synthetic.texture import Colour, Facade, Material, Mottled, Noise, RoofTiles

_WALLS: tuple[Colour, ...] = (
    (0.86, 0.82, 0.74),
    (0.80, 0.70, 0.58),
    (0.76, 0.77, 0.76),
    (0.84, 0.74, 0.60),
    (0.70, 0.56, 0.48),
    (0.82, 0.80, 0.66),
)
_TILES: tuple[Colour, ...] = ((0.66, 0.36, 0.27), (0.58, 0.30, 0.23), (0.48, 0.33, 0.27), (0.40, 0.41, 0.44))
_FLAT: tuple[Colour, ...] = ((0.60, 0.59, 0.56), (0.52, 0.52, 0.52), (0.66, 0.62, 0.55))
_LEAVES: tuple[Colour, ...] = ((0.31, 0.43, 0.20), (0.26, 0.38, 0.19), (0.38, 0.46, 0.22), (0.42, 0.42, 0.20))
_PAINTWORK: tuple[Colour, ...] = (
    (0.75, 0.16, 0.14),
    (0.85, 0.85, 0.84),
    (0.22, 0.32, 0.52),
    (0.45, 0.47, 0.49),
)
# World rectangle that is built upon, and the larger one that is painted; half sizes in metres.
_BUILT = (104.0, 84.0)
_PAINTED = (140.0, 120.0)
_CROWN_PARTS = 8
_TRIES = 4000


@dataclass(frozen=True)
class Village:
    """The scene and its parts.

    Attributes
    ----------
    surfaces : tuple of Surface
        The terrain first.
    terrain : Terrain
    plots : tuple of Plot
        One per building.
    """

    surfaces: tuple[Surface, ...]
    terrain: Terrain
    plots: tuple[Plot, ...]


def _roads() -> list[Road]:
    x = np.arange(-_PAINTED[0], _PAINTED[0], 0.5)
    y = np.arange(-_PAINTED[1], _PAINTED[1], 0.5)
    main = np.column_stack([x, 7.0 * np.sin(x / 34.0)])
    side = np.column_stack([14.0 + 6.0 * np.sin(y / 27.0), y])
    return [Road(main, 6.5), Road(side, 5.5)]


def _road_sites(roads: list[Road], rng: np.random.Generator) -> list[tuple[FloatArray, float]]:
    """Building sites (place, yaw) along the roads, in random order."""
    sites = []
    for road in roads:
        direction = np.gradient(road.line, axis=0)
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        for side in (-1.0, 1.0):
            index = int(rng.integers(4, 20))
            while index < len(road.line):
                along = direction[index]
                setback = side * (road.width / 2 + rng.uniform(8.5, 11.5))
                place = road.line[index] + setback * np.array([-along[1], along[0]])
                yaw = float(np.arctan2(along[1], along[0])) + rng.choice([0.0, 0.0, np.pi / 2])
                sites.append((place, yaw + rng.normal(0, 0.05)))
                index += int(rng.integers(34, 44))
    return [sites[k] for k in rng.permutation(len(sites))]


def _plots(count: int, roads: list[Road], rng: np.random.Generator) -> list[Plot]:
    """Plots that touch neither each other nor a road: along the roads first, then anywhere."""
    sites = _road_sites(roads, rng)
    plots: list[Plot] = []
    for attempt in range(_TRIES):
        if len(plots) >= count:
            break
        if attempt < len(sites):
            centre, yaw = sites[attempt]
        else:
            centre = rng.uniform(-1, 1, 2) * _BUILT
            yaw = rng.uniform(0, np.pi)
        large = rng.random() < 0.28
        size = (rng.uniform(13, 19), rng.uniform(10, 12)) if large else (rng.uniform(9, 12), rng.uniform(7, 9))
        radius = 0.5 * np.hypot(*size)
        free = np.all(np.abs(centre) < _BUILT) and all(
            np.hypot(*(plot.centre - centre)) > radius + 0.5 * np.hypot(*plot.size) + 1.0 for plot in plots
        )
        if free and all(road.distance(centre[None])[0] > radius + road.width / 2 + 1.6 for road in roads):
            plots.append(Plot(centre, size, yaw, rng.uniform(5.0, 8.0)))
    return plots


def _terrain(rng: np.random.Generator, ground: Material) -> Terrain:
    lengths = np.array([150.0, 95.0, 58.0])
    directions = rng.uniform(0, 2 * np.pi, 3)
    waves = (2 * np.pi / lengths)[:, None] * np.column_stack([np.cos(directions), np.sin(directions)])
    return Terrain(0.0, np.array([2.6, 1.3, 0.5]), waves, rng.uniform(0, 2 * np.pi, 3), ground)


def _building(
    plot: Plot, terrain: Terrain, noise: Noise, rng: np.random.Generator, taller: int
) -> list[ConvexPolyhedron]:
    """One building with what stands on its roof; its base lies below the lowest ground."""
    length, width = plot.size
    turn = np.array([[np.cos(plot.yaw), -np.sin(plot.yaw)], [np.sin(plot.yaw), np.cos(plot.yaw)]])
    corners = plot.centre + np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * [length / 2, width / 2] @ turn.T
    level = float(terrain.height(corners[:, 0], corners[:, 1]).min()) - 0.2
    base = np.array([*plot.centre, level])
    offset = (float(rng.uniform(0, 60)), float(rng.uniform(0, 60)))
    wall = _WALLS[rng.integers(len(_WALLS))]
    storeys = taller * (int(rng.integers(2, 5)) if length > 12.5 else int(rng.integers(1, 3)))
    height = 3.0 * storeys + 0.7
    gable = Facade(noise, wall, height, width, offset)
    front = Facade(noise, wall, height, length, offset)

    def on_roof(
        x: float, y: float, foot: float, size: tuple[float, float, float], cover: Material
    ) -> ConvexPolyhedron:
        place = plot.centre + turn @ [x, y]
        return box((place[0], place[1], level + foot), size, (cover,), plot.yaw)

    if length > 12.5 and rng.random() < 0.7:
        roof: Material = Mottled(noise, _FLAT[rng.integers(len(_FLAT))], 0.13, offset)
        parts = [box(base, (length, width, height), (gable, gable, front, front, roof), plot.yaw)]
        metal = Mottled(noise, (0.74, 0.75, 0.76), 0.10, offset)
        for _ in range(int(rng.integers(2, 5))):
            x, y = rng.uniform(-0.36, 0.36, 2) * [length, width]
            size = (rng.uniform(1.0, 2.6), rng.uniform(1.0, 2.2), rng.uniform(0.7, 1.8))
            parts.append(on_roof(x, y, height - 0.05, size, metal))
        return parts
    rise = width / 2 * rng.uniform(0.55, 0.95)
    roof = RoofTiles(noise, _TILES[rng.integers(len(_TILES))], offset)
    materials = (gable, gable, front, front, roof, roof, roof, roof)
    house = gabled_house(
        base, (length, width, height), height + rise, materials, plot.yaw, hipped=bool(rng.random() < 0.25)
    )
    brick = Mottled(noise, (0.55, 0.35, 0.28), 0.15, offset)
    chimney = on_roof(rng.uniform(-0.25, 0.25) * length, 0.8, height, (0.8, 0.8, rise + 0.8), brick)
    return [house, chimney]


def _tree(place: FloatArray, terrain: Terrain, noise: Noise, rng: np.random.Generator) -> list[Ellipsoid]:
    """A crown of a few overlapping ellipsoids."""
    radius = rng.uniform(1.8, 3.8)
    ground = float(terrain.height(place[0], place[1]))
    colour = _LEAVES[rng.integers(len(_LEAVES))]
    parts = []
    for number in range(_CROWN_PARTS):
        share = 0.82 if number == 0 else rng.uniform(0.36, 0.58)
        # The golden angle spreads the boughs evenly about the stem.
        bearing = 2.4 * number + rng.uniform(-0.4, 0.4)
        rise = rng.uniform(-0.15, 0.75)
        reach = 0.0 if number == 0 else np.sqrt(1.0 - rise**2) * 0.68
        shift = radius * np.array([reach * np.cos(bearing), reach * np.sin(bearing), 0.8 * rise * (number > 0)])
        radii = radius * share * np.array([1.0, 1.0, rng.uniform(0.8, 1.1)])
        centre = np.array([*place, ground + 1.1 * radius]) + shift
        leaves = Mottled(noise, colour, 0.27, tuple(rng.uniform(0, 60, 2)), stretch=1.3)
        parts.append(Ellipsoid(centre, radii, leaves))
    return parts


def _trees(count: int, plots: list[Plot], roads: list[Road], rng: np.random.Generator) -> list[FloatArray]:
    """Places for trees: a grove in each of three corners, the others scattered about."""
    groves = np.array([[-78.0, 62.0], [84.0, -60.0], [-70.0, -64.0]])
    places: list[FloatArray] = []
    for attempt in range(_TRIES):
        if len(places) >= count:
            break
        if attempt % 2:
            place = groves[rng.integers(len(groves))] + rng.normal(0, 11.0, 2)
        else:
            place = rng.uniform(-0.8, 0.8, 2) * _BUILT
        clear = all(road.distance(place[None])[0] > road.width / 2 + 3.5 for road in roads)
        clear &= all(np.hypot(*(plot.centre - place)) > 0.5 * np.hypot(*plot.size) + 2.2 for plot in plots)
        if clear and all(np.hypot(*(other - place)) > 3.2 for other in places):
            places.append(place)
    return places


def _cars(roads: list[Road], terrain: Terrain, noise: Noise, rng: np.random.Generator) -> list[ConvexPolyhedron]:
    """Cars on both lanes, each a body and a cabin."""
    parts = []
    for road in roads:
        direction = np.gradient(road.line, axis=0)
        for index in rng.choice(np.arange(60, len(road.line) - 60, 24), 8, replace=False):
            along = direction[index] / np.linalg.norm(direction[index])
            lane = rng.choice([-1.0, 1.0]) * road.width / 4
            place = road.line[index] + lane * np.array([-along[1], along[0]])
            yaw = float(np.arctan2(along[1], along[0]))
            foot = float(terrain.height(*place))
            offset = (float(rng.uniform(0, 60)), 0.0)
            body = Mottled(noise, _PAINTWORK[rng.integers(len(_PAINTWORK))], 0.07, offset)
            glass = Mottled(noise, (0.20, 0.23, 0.27), 0.12, offset)
            parts.append(box((*place, foot - 0.3), (4.3, 1.8, 1.2), (body,), yaw))
            parts.append(box((*place, foot + 0.8), (2.2, 1.6, 0.6), (glass, glass, glass, glass, body), yaw))
    return parts


def build_village(gsd: float, buildings: int, trees: int, seed: int, *, storeys: int = 1) -> Village:
    """Lay out the demo's scene.

    Parameters
    ----------
    gsd : float
        Ground sampling distance in metres that the texture is made for.
    buildings, trees : int
        How many; fewer where there is no room.
    seed : int
        The same seed gives the same village.
    storeys : int
        The buildings have so many times the storeys of a village's, which are 1 to 4.

    Returns
    -------
    Village
    """
    rng = np.random.default_rng(seed)
    noise = Noise(gsd, seed)
    roads = _roads()
    plots = _plots(buildings, roads, rng)
    extent = (-_PAINTED[0], -_PAINTED[1], _PAINTED[0], _PAINTED[1])
    terrain = _terrain(rng, paint_ground(extent, noise, plots, roads, rng))
    surfaces: list[Surface] = [terrain]
    for plot in plots:
        surfaces += _building(plot, terrain, noise, rng, storeys)
    for place in _trees(trees, plots, roads, rng):
        surfaces += _tree(place, terrain, noise, rng)
    surfaces += _cars(roads, terrain, noise, rng)
    return Village(tuple(surfaces), terrain, tuple(plots))
