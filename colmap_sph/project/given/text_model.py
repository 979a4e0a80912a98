"""COLMAP text model → pycolmap model, with all that COLMAP's own reader loses, and a sentence for every bad line.

COLMAP's reader (4.2.1) takes every second line of ``images.txt`` for features, whatever is in it: where exporters
leave out the empty second lines, every other image is lost without a word. It cuts names off at the first space,
and leaves out the rest of a line of features or of a track from the first word on that is not a number. So the
lines are looked at first. Second lines that are missing, marks of byte order and comments between an image and its
features are mended in a copy for COLMAP to read; anything else that it would not read as it stands there is
refused.
"""

import logging
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from colmap_sph.errors import InputError, OutputError, reason_of
from colmap_sph.project.files import open_regular
from colmap_sph.project.given.poses import check_written_poses, normalize_rotations

logger = logging.getLogger(__name__)

# What the C++ library takes for white space.
_WHITE = b" \t\n\v\f\r"
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_WIDE_MARKS = (b"\xff\xfe", b"\xfe\xff")
_SHOWN = 60
# COLMAP's numbers of cameras and images have 32 bits, those of points 64; the last one stands for none.
_END_OF_IDS = 2**32 - 1
_END_OF_POINT_IDS = 2**64 - 1

# Possessive, so that a line of any length is looked at once.
_COUNT = rb"\d++"
_INTEGER = rb"[-+]?+\d++"
_NUMBER = rb"[-+]?+(?:\d++(?:\.\d*+)?+|\.\d++)(?:[eE][-+]?+\d++)?+"
_GAP = rb"[ \t]++"
_CAMERA = re.compile(rb"(%b)%b(\w++)(?:%b%b){2}(?:%b%b)++" % (_COUNT, _GAP, _GAP, _INTEGER, _GAP, _NUMBER))
_IMAGE = re.compile(rb"(%b)((?:%b%b){7})%b(%b)%b(.++)" % (_COUNT, _GAP, _NUMBER, _GAP, _COUNT, _GAP))
_FEATURES = re.compile(rb"(?:%b%b%b%b%b(?:%b|\Z))*+" % (_NUMBER, _GAP, _NUMBER, _GAP, _INTEGER, _GAP))
_POINT = re.compile(
    rb"(%b)(?:%b%b){3}(?:%b%b){3}%b%b(?:%b%b%b%b)*+"
    % (_COUNT, _GAP, _NUMBER, _GAP, _INTEGER, _GAP, _NUMBER, _GAP, _COUNT, _GAP, _COUNT)
)

_CAMERA_LINE = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
_IMAGE_LINE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_FEATURES_LINE = "X Y POINT3D_ID of each of its features (nothing where it has none)"
_POINT_LINE = "POINT3D_ID X Y Z R G B ERROR and pairs of IMAGE_ID POINT2D_IDX"


@dataclass(frozen=True)
class _Line:
    """A line without white space around it, and where it is."""

    path: Path
    number: int
    text: bytes

    def refusal(self, lack: str) -> InputError:
        shown = self.text.decode(errors="replace")
        shown = shown if len(shown) <= _SHOWN else shown[:_SHOWN] + "…"
        return InputError(f"{self.path}, line {self.number}, {shown!r}: {lack}; export the model again.")

    def is_told(self) -> bool:
        """Whether the line holds anything but a comment."""
        return bool(self.text) and not self.text.startswith(b"#")


@dataclass(frozen=True)
class _Image:
    """An image of ``images.txt``, and the lines that it is read from."""

    image_id: int
    name: str
    camera_id: int
    pose: bytes
    features: bytes

    @property
    def num_features(self) -> int:
        return len(self.features.split()) // 3


def read_text_model(files: list[Path]) -> pycolmap.Reconstruction:
    """Read a text model.

    Parameters
    ----------
    files : list of Path
        ``cameras.txt``, ``images.txt`` and ``points3D.txt``, with or without ``rigs.txt`` and
        ``frames.txt``, of one folder.

    Returns
    -------
    pycolmap.Reconstruction
        With every camera, image, feature and point of the files.

    Raises
    ------
    InputError
        A file cannot be read, or a line is not what it should be; the message names it.
    Exception
        COLMAP's own, where the lines contradict each other; for the caller to put into a sentence.
    """
    lines = {path.name: _lines_of(path) for path in files}
    camera_ids = _checked_ids(lines["cameras.txt"], _CAMERA, _CAMERA_LINE)
    _check_parameters(lines["cameras.txt"])
    point_ids = _checked_ids(lines["points3D.txt"], _POINT, _POINT_LINE, end=_END_OF_POINT_IDS)
    images, is_whole = _read_images(lines["images.txt"], camera_ids)
    model = pycolmap.Reconstruction()
    try:
        if is_whole and not any(_has_mark(path) for path in files):
            model.read_text(files[0].parent)
        else:
            _read_mended(model, lines, images, files[0].parent)
    except (IndexError, KeyError):
        _check_tracks(lines["points3D.txt"], images)
        raise
    normalize_rotations(model)
    folder = files[0].parent
    written = {image.image_id: tuple(map(float, image.pose.split())) for image in images}
    _check_count(folder, "images", len(images), model.num_images())
    _check_count(folder, "points", len(point_ids), model.num_points3D())
    for image in images:
        read = model.image(image.image_id)
        read.name = image.name
        _check_count(folder, f"features of {image.name!r}", image.num_features, read.num_points2D())
        if not any(written[image.image_id][:4]):  # COLMAP makes some rotation of it
            raise InputError(
                f"The model in {folder} has no rotation of {image.name!r}: its quaternion in images.txt is zero; "
                "export the model again, or remove the image."
            )
    check_written_poses(model, written, files)
    return model


def _lines_of(path: Path) -> list[_Line]:
    try:
        with open_regular(path) as file:
            data = file.read()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({reason_of(error)}); check the file.") from error
    if data.startswith(_WIDE_MARKS):
        raise InputError(f"{path} is written in UTF-16, which COLMAP does not read; save it as UTF-8.")
    lines = data.removeprefix(_BYTE_ORDER_MARK).split(b"\n")
    return [_Line(path, number, line.strip(_WHITE)) for number, line in enumerate(lines, start=1)]


def _has_mark(path: Path) -> bool:
    with open_regular(path) as file:
        return file.read(len(_BYTE_ORDER_MARK)) == _BYTE_ORDER_MARK


def _checked_ids(
    lines: list[_Line], pattern: re.Pattern[bytes], wanted: str, *, end: int = _END_OF_IDS
) -> dict[int, int]:
    """Return the number of the line of each id; every line but comments must be as the pattern says."""
    ids: dict[int, int] = {}
    for line in filter(_Line.is_told, lines):
        match = pattern.fullmatch(line.text)
        if match is None:
            raise line.refusal(f"this is not {wanted}")
        _add_id(ids, int(match[1]), line, end=end)
    return ids


def _add_id(ids: dict[int, int], key: int, line: _Line, *, end: int = _END_OF_IDS) -> None:
    if key >= end:
        raise line.refusal(f"its number is too large, as COLMAP's end at {end - 1}")
    if key in ids:
        raise line.refusal(f"the number {key} is that of line {ids[key]}, too")
    ids[key] = line.number


def _check_parameters(lines: list[_Line]) -> None:
    """Every camera must be of a known model and have its number of parameters."""
    for line in filter(_Line.is_told, lines):
        model = line.text.split()[1].decode()
        if model == "INVALID" or model not in pycolmap.CameraModelId.__members__:
            raise line.refusal(f"COLMAP has no camera model {model!r}")
        needed = len(pycolmap.Camera.create_from_model_name(0, model, 1, 1, 1).params)
        given = len(line.text.split()) - 4
        if given != needed:
            raise line.refusal(f"a {model} camera has {needed} parameters, not {given}")


def _read_images(lines: list[_Line], camera_ids: dict[int, int]) -> tuple[list[_Image], bool]:
    """Return the images, and whether COLMAP would find the lines where it looks for them."""
    images = []
    ids: dict[int, int] = {}
    missing = 0
    is_whole = True
    for first, match, second in _pairs_of_lines(lines):
        _add_id(ids, int(match[1]), first)
        if int(match[3]) not in camera_ids:
            raise first.refusal(f"its camera {int(match[3])} is not in cameras.txt")
        missing += second is None
        is_whole = is_whole and second is not None and second.number == first.number + 1
        features = b"" if second is None else second.text
        images.append(_Image(int(match[1]), match[4].decode(), int(match[3]), match[2], features))
    if missing:
        logger.warning(
            "%s has no second line for %d of its %d images; they are read as images without features, where "
            "COLMAP itself would lose some",
            lines[0].path,
            missing,
            len(images),
        )
    return images, is_whole


def _pairs_of_lines(lines: list[_Line]) -> Iterator[tuple[_Line, re.Match[bytes], _Line | None]]:
    """Each image's first line, how it is taken apart, and its second line, or None where that is missing."""
    place = 0
    while place < len(lines):
        first = lines[place]
        place += 1
        if not first.is_told():
            continue
        match = _IMAGE.fullmatch(first.text)
        if match is None:
            raise first.refusal(f"this is not {_IMAGE_LINE}")
        while place < len(lines) and lines[place].text.startswith(b"#"):
            place += 1
        # Behind the last line break of the file there is no line.
        if place >= len(lines) - (not lines[-1].text):
            yield first, match, None
        elif _FEATURES.fullmatch(lines[place].text):
            yield first, match, lines[place]
            place += 1
        elif _IMAGE.fullmatch(lines[place].text):
            yield first, match, None
        else:
            raise lines[place].refusal(f"this is not {_FEATURES_LINE}")


def _read_mended(
    model: pycolmap.Reconstruction, lines: dict[str, list[_Line]], images: list[_Image], original: Path
) -> None:
    """Let COLMAP read a copy of the files that it reads rightly."""
    pairs = [
        (b"%d%b %d %d" % (image.image_id, image.pose, image.camera_id, image.image_id), image.features)
        for image in images
    ]
    texts = {name: [line.text for line in lines[name]] for name in lines}
    texts["images.txt"] = [text for pair in pairs for text in pair]
    try:
        with tempfile.TemporaryDirectory() as folder:
            for name, each in texts.items():
                (Path(folder) / name).write_bytes(b"".join(text + b"\n" for text in each))
            model.read_text(folder)
    except OSError as error:
        raise OutputError(
            f"A copy of the model in {original} that COLMAP reads rightly cannot be written ({reason_of(error)}); "
            "make space where temporary files go, or name another folder by the variable TMPDIR."
        ) from error


def _check_tracks(lines: list[_Line], images: list[_Image]) -> None:
    """Find the point that is seen by a feature which is not there."""
    num_features = {image.image_id: image.num_features for image in images}
    for line in filter(_Line.is_told, lines):
        words = line.text.split()[8:]
        for image_id, feature in zip(map(int, words[::2]), map(int, words[1::2]), strict=True):
            if image_id not in num_features:
                raise line.refusal(f"images.txt has no image {image_id}, which observes it")
            if feature >= num_features[image_id]:
                raise line.refusal(f"image {image_id} in images.txt has no feature {feature}")


def _check_count(folder: Path, what: str, written: int, read: int) -> None:
    """Nothing may be lost between the lines and what COLMAP made of them."""
    if written != read:
        raise InputError(
            f"The model in {folder} has {written} {what}, of which COLMAP reads {read}; "
            "export the model from COLMAP again."
        )
