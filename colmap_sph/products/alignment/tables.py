"""Tables of camera positions and control points, as text with a line of column names → records.

Columns are separated by commas, semicolons or tabs. Of camera positions each line has an image and its place::

    image,x,y,z                            or  image,latitude,longitude,height

Of control points each line has a mark in an image; the place may be left out after a point's first line::

    point,x,y,z,image,column,row           and maybe role: control or check

Lines that begin with # are comments; a name that begins with it is put into quotes.
"""

import csv
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from colmap_sph.errors import InputError, counted, reason_of
from colmap_sph.project.files import read_small

logger = logging.getLogger(__name__)

_MAX_BYTES = 64 << 20
# Each column, and what else it is called.
_COLUMNS = {
    "image": ("image", "name", "label", "filename", "file", "photo", "image_name"),
    "point": ("point", "gcp", "point_name", "marker"),
    "x": ("x", "east", "easting"),
    "y": ("y", "north", "northing"),
    "z": ("z",),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon", "lng", "long"),
    "height": ("height", "altitude", "alt", "elevation"),
    "column": ("column", "col", "u", "px", "pixel_x"),
    "row": ("row", "v", "py", "pixel_y"),
    "role": ("role",),
}
_CALLED = {name: column for column, names in _COLUMNS.items() for name in names}
_NUMBERS = ("x", "y", "z", "latitude", "longitude", "height", "column", "row")
_ROLES = {"": False, "control": False, "check": True}

Place = tuple[float, float, float]


@dataclass(frozen=True)
class Positions:
    """Places of cameras by the name of the image; in degrees and metres where they are geographic."""

    places: dict[str, Place]
    is_geographic: bool


@dataclass(frozen=True)
class ControlPoint:
    """A place on the map, and where it is marked: image, column and row, and the line that says so."""

    name: str
    place: Place
    is_check: bool
    marks: list[tuple[str, float, float, int]] = field(default_factory=list)


def read_table(path: Path) -> Positions | list[ControlPoint]:
    """Read a table of camera positions or of control points.

    Raises
    ------
    InputError
        It cannot be read, or a line is not as it must be; the message names it.
    """
    try:
        text = read_small(path, _MAX_BYTES).decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"{path} cannot be read ({reason_of(error)}); check --align.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text in UTF-8; save it as CSV with that encoding.") from error
    try:
        lines = _Lines(path, text)
        return _control_points(lines) if "point" in lines.columns else _positions(lines)
    except csv.Error as error:
        raise InputError(f"{path} is no table ({reason_of(error)}); check --align.") from error


class _Lines:
    """The lines of a table that hold something, each by its columns."""

    def __init__(self, path: Path, text: str) -> None:
        self.path = path
        lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
        comments = [line for _, line in lines if line.lstrip().startswith("#")]
        self._rows = [(number, line) for number, line in lines if not line.lstrip().startswith("#")]
        head = self._rows[0][1] if self._rows else ""
        self._delimiter = next((each for each in "\t;" if each in head), ",")
        names = [name.strip().lower().replace(" ", "_") for name in self._split(head)]
        self.columns = [_CALLED.get(name, "") for name in names]
        known = [column for column in self.columns if column]
        if len(set(known)) < len(known):
            raise InputError(f"{path} has two columns of one meaning in its first line; leave one out.")
        self._tell_comments(comments)

    def _tell_comments(self, comments: Sequence[str]) -> None:
        """Warn of comments that look like lines of the table: a name may begin with #."""
        told = [comment for comment in comments if self._is_line(comment)]
        if told:
            logger.warning(
                "%s: %s like %r not read, as # begins a comment; put a name that begins with # into quotes",
                self.path,
                counted(len(told), "line"),
                self._split(told[0])[0].strip(),
            )

    def _is_line(self, comment: str) -> bool:
        """Whether a comment has a value for each column, numbers where these must be."""
        try:
            cells = self._split(comment)
        except csv.Error:
            return False
        if len(cells) != len(self.columns):
            return False
        pairs = zip(cells, self.columns, strict=True)
        values = [self._number(cell) for cell, column in pairs if column in _NUMBERS and cell.strip()]
        return bool(values) and not any(map(math.isnan, values))

    def _split(self, line: str) -> list[str]:
        return next(csv.reader([line], delimiter=self._delimiter), [])

    def _number(self, text: str) -> float:
        """Its value, NaN where it is no number; where commas do not separate columns, they may be decimal."""
        try:
            return float(text if self._delimiter == "," else text.replace(",", "."))
        except ValueError:
            return math.nan

    def require(self, columns: Sequence[str]) -> None:
        """Raise `InputError` where one of the columns is missing."""
        missing = [column for column in columns if column not in self.columns]
        if missing:
            raise InputError(
                f"{self.path} has no column {' and no '.join(missing)}; its first line must name the columns: "
                "image,x,y,z or image,latitude,longitude,height of cameras, point,x,y,z,image,column,row of "
                "control points."
            )

    def __iter__(self) -> Iterator[tuple[int, dict[str, str]]]:
        for number, line in self._rows[1:]:
            cells = [cell.strip() for cell in self._split(line)]
            if len(cells) != len(self.columns):
                raise InputError(
                    f"{self.path}, line {number}, has {len(cells)} values, and the first line names "
                    f"{len(self.columns)} columns; correct it."
                )
            yield number, dict(zip(self.columns, cells, strict=True))

    def numbers(self, number: int, cells: dict[str, str], columns: Sequence[str]) -> list[float]:
        """The numbers of some columns."""
        found = []
        for column in columns:
            value = self._number(cells[column])
            if not math.isfinite(value):
                raise InputError(
                    f"{self.path}, line {number}: {column} is {cells[column]!r}, which is no number; correct it."
                )
            found.append(value)
        return found

    def wrong(self, number: int, what: str) -> InputError:
        """What is wrong with a line."""
        return InputError(f"{self.path}, line {number}: {what}; correct it.")


def _positions(lines: _Lines) -> Positions:
    is_geographic = "latitude" in lines.columns
    columns = ("latitude", "longitude", "height") if is_geographic else ("x", "y", "z")
    lines.require(["image", *columns])
    places: dict[str, Place] = {}
    for number, cells in lines:
        name = cells["image"]
        first, second, third = lines.numbers(number, cells, columns)
        if not name or name in places:
            raise lines.wrong(number, f"the image {name!r} is there already" if name else "it names no image")
        if is_geographic and not (abs(first) <= 90 and abs(second) <= 360):
            raise lines.wrong(number, f"{first:g}, {second:g} is no latitude and longitude in degrees")
        places[name] = (first, second, third)
    return Positions(places, is_geographic)


def _control_points(lines: _Lines) -> list[ControlPoint]:
    lines.require(["point", "x", "y", "z", "image", "column", "row"])
    points: dict[str, ControlPoint] = {}
    for number, cells in lines:
        name = cells["point"]
        if not name:
            raise lines.wrong(number, "it names no point")
        given = any(cells[axis] for axis in "xyz")
        if not given and name not in points:
            raise lines.wrong(number, f"the point {name!r} has no x, y and z in its first line")
        role = cells.get("role", "").lower()
        if role not in _ROLES:
            raise lines.wrong(number, f"the role {role!r} is neither control nor check")
        if given:
            x, y, z = lines.numbers(number, cells, "xyz")
            point = points.setdefault(name, ControlPoint(name, (x, y, z), _ROLES[role]))
            if point.place != (x, y, z):
                raise lines.wrong(number, f"the point {name!r} had another place before")
        if role and points[name].is_check != _ROLES[role]:
            raise lines.wrong(number, f"the point {name!r} had another role before")
        column, row = lines.numbers(number, cells, ("column", "row"))
        points[name].marks.append((cells["image"], column, row, number))
    return list(points.values())
