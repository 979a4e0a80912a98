"""Before anything else: every image is decoded once, and what is known of it is kept with a digest of its content.

A file whose size, times and place on the disk are as they were is not read again; one that was copied is read for
its digest, and decoded only if that is new.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from colmap_sph.errors import InputError
from colmap_sph.pipeline.digests import digest, file_digest, stamp_of
from colmap_sph.pipeline.known.kept import read_kept, write_kept
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.stage import Cost, Job, Result, Stage
from colmap_sph.project.given.image_places import tell_problems
from colmap_sph.project.images.decoding import is_jpeg
from colmap_sph.project.images.depth import ValueSample, sample_values
from colmap_sph.project.images.reading import Problem, image_problem, read_grey
from colmap_sph.project.workspace import checked_name
from colmap_sph.stereo.detail import image_detail

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context

Size = tuple[int, int]

# Processor seconds per megapixel, and largest bytes in use per pixel, while an image is decoded: other files than
# JPEG may hold colours as floating-point numbers.
_SECONDS = 0.012
_JPEG_BYTES = 12.0
_OTHER_BYTES = 25.0
# Seconds to measure its detail.
_DETAIL_SECONDS = 0.03


@dataclass(frozen=True)
class ImageFile:
    """An image, the size (width, height) that it must have, and the one at which its detail is asked for."""

    path: Path
    size: Size
    detail_size: Size | None


@dataclass(frozen=True)
class ImageFacts(Facts):
    """Of an image: a sample of its values, if it has more than 8 bits, and its detail, if that was measured."""

    sample: ValueSample | None = None
    detail: float | None = None


def check_image(task: ImageFile) -> ImageFacts:
    """Decode an image; `InputError` where it is missing, damaged or of another size."""
    # To read its grey values tells of damage, too: colours are decoded only where these are not asked for.
    problem = image_problem(task.path, *task.size, decode=task.detail_size is None)
    detail = None
    if problem is None and task.detail_size:
        try:
            detail = image_detail(read_grey(task.path, task.detail_size))
        except InputError:
            problem = image_problem(task.path, *task.size)
            if problem is None:
                raise
    if problem is not None:
        raise InputError(f"{task.path} {problem}")
    return ImageFacts(sample=sample_values(task.path), detail=detail)


@dataclass(frozen=True)
class KnownImage:
    """Of an image that was found good: its size, the digest of its content, when that was read, and its facts.

    `doubt` is empty but for an image that was changed while a run worked with it, see `tell_changed`.
    """

    size: Size
    digest: str
    stamp: tuple[int, ...]
    sample: ValueSample | None = None
    detail: float | None = None
    detail_size: Size | None = None
    doubt: str = ""

    @property
    def key(self) -> str:
        """What stands for its content in the keys of all that is made of it."""
        return digest(self.digest, self.doubt) if self.doubt else self.digest


def read_known(path: Path, key: str) -> dict[str, KnownImage]:
    """Read what `write_known` wrote under this key; nothing where the file holds anything else."""
    return read_kept(path, key, dict[str, KnownImage]) or {}


def write_known(path: Path, key: str, images: Mapping[str, KnownImage]) -> None:
    """Keep what is known of images; `OutputError` where that fails."""
    write_kept(path, key, images, sync=True)  # doubts are not found out again


@dataclass(frozen=True)
class ImagePlaces:
    """Where images are, and how to speak of them.

    Attributes
    ----------
    what : {"originals", "images"}
        As a workspace's own are called after they were undistorted: the second.
    model_dir, folder : Path
        The model that names them, and their folder.
    """

    what: Literal["originals", "images"]
    model_dir: Path
    folder: Path

    def path(self, name: str) -> Path:
        """File of an image; need not exist."""
        return self.folder / checked_name(name)

    def known_file(self, context: "Context") -> Path:
        """File of what is known of them from run to run."""
        return context.workspace.images_known_path(self.what)


class CheckStage(Stage[str, ImageFile]):
    """Checks images, and measures the detail of undistorted ones. Its keys are the digests of their contents.

    Parameters
    ----------
    context : Context
    sizes : mapping of str to (int, int)
        Width and height of each image by its name.
    places : ImagePlaces
    detail_sizes : mapping of str to (int, int), optional
        Width and height at which each image's detail is measured; without it, it is not.
    verify : bool
        Whether what is known does not count, but for doubts.
    """

    make = staticmethod(check_image)

    def __init__(
        self,
        context: "Context",
        sizes: Mapping[str, Size],
        places: ImagePlaces,
        detail_sizes: Mapping[str, Size] | None = None,
        *,
        verify: bool = False,
    ) -> None:
        super().__init__(context, sorted(sizes))
        self.name = f"check {places.what}"  # type: ignore[misc]
        self._detail_sizes = detail_sizes or {}
        self._sizes = sizes
        self._places = places
        self._bad: dict[str, str] = {}
        self._file = places.known_file(context)
        self._key = context.keys.known_images()
        self._known = {} if context.keys.fresh else read_known(self._file, self._key)
        if verify:
            self._known = {
                name: replace(each, digest="", stamp=()) for name, each in self._known.items() if each.doubt
            }
        self._seen: dict[str, KnownImage] = {}

    @property
    def is_new(self) -> bool:
        """Whether nothing is known of any image yet."""
        return not self._known

    def job(self, item: str) -> Job[ImageFile]:
        """See `Stage.job`."""
        image = ImageFile(self._places.path(item), self._sizes[item], self._detail_sizes.get(item))
        problem = image_problem(image.path, *image.size, decode=False)
        if problem is not None:
            raise InputError(f"{image.path} {problem}")
        stamp = stamp_of(image.path.stat())
        known = self._known.get(item)
        is_read = known is not None and known.stamp == stamp
        content = known.digest if known is not None and is_read else file_digest(image.path)
        doubt = "" if known is None else known.doubt
        seen = KnownImage(image.size, content, stamp, detail_size=image.detail_size, doubt=doubt)
        self._seen[item] = seen
        facts = None
        wanted = (content, image.size, image.detail_size)
        if known is not None and (known.digest, known.size, known.detail_size) == wanted:
            facts = ImageFacts(sample=known.sample, detail=known.detail)
        return Job(seen.key, facts, self._cost(image), image)

    def _cost(self, image: ImageFile) -> Cost:
        pixels = image.size[0] * image.size[1]
        seconds = _SECONDS * pixels / 1e6
        memory = (_JPEG_BYTES if is_jpeg(image.path) else _OTHER_BYTES) * pixels
        if image.detail_size:
            seconds += _DETAIL_SECONDS
        return Cost(seconds, memory, 0.0)

    def skip(self, item: str, reason: str) -> None:
        """See `Stage.skip`."""
        self.context.report.skipped_images[item] = reason
        self.context.progress.leave_out("image", item, reason)
        self._bad[item] = reason.removeprefix(f"{self._places.path(item)} ")

    def close(self, results: Mapping[str, Result]) -> None:
        """Tell what is wrong with bad images, and keep what is known of the good ones."""
        self.tell_problems()
        good = {
            name: replace(self._seen[name], sample=result.facts.sample, detail=result.facts.detail)
            for name, result in results.items()
            if isinstance(result.facts, ImageFacts)
        }
        # A doubt stays, also where an image is bad today, or not among those that are asked for.
        known = {name: each for name, each in self._known.items() if each.doubt} | good
        if known != self._known:
            write_known(self._file, self._key, known)

    def tell_problems(self) -> None:
        """Tell what is wrong with bad images; `InputError` where there is no other."""
        places = self._places
        problems = {
            name: image_problem(places.path(name), *self._sizes[name]) or Problem(reason)
            for name, reason in sorted(self._bad.items())
        }
        tell_problems(
            places.model_dir, places.folder, problems, len(self.items), undistorted=places.what == "images"
        )

    def count(self, results: Mapping[str, Result]) -> tuple[int, int]:
        """None: it makes no files."""
        return 0, 0


def details_of(results: Mapping[str, Result]) -> dict[str, float]:
    """Detail of each image of which it is known."""
    return {
        name: result.facts.detail
        for name, result in results.items()
        if isinstance(result.facts, ImageFacts) and result.facts.detail is not None
    }


def tell_changed(
    context: "Context",
    places: ImagePlaces,
    names: Collection[str],
    masks_of: Callable[[str], Iterable[Path | None]],
) -> None:
    """Report images that are not as they were checked, or whose masks are not: either may be in what was made.

    Their keys change, so that the next run makes all of it anew, also where the former content is there again.

    Parameters
    ----------
    context : Context
    places : ImagePlaces
    names : collection of str
        Images that were found good. One that is gone was there when it was read, or was reported then.
    masks_of : callable
        Name → where its masks are, or would be; None where it can have none.
    """
    file, key = places.known_file(context), context.keys.known_images()
    known = read_known(file, key)
    changed = {}
    for name in sorted(known.keys() & {*names}):
        image = places.path(name)
        with suppress(OSError, InputError):
            if _is_changed(image, known[name]):
                changed[name] = image
                continue
            for mask in filter(None, masks_of(name)):
                if context.keys.is_mask_changed(mask):
                    changed[name] = mask
    if changed:
        doubted = {name: replace(known[name], doubt=digest(known[name].doubt, "doubt")) for name in changed}
        write_known(file, key, known | doubted)
    for name, path in changed.items():
        context.leave_incomplete(name, f"{path} was changed while the run was at work; run again")


def _is_changed(path: Path, known: KnownImage) -> bool:
    return stamp_of(path.stat()) != known.stamp and file_digest(path) != known.digest
