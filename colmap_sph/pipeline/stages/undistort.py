"""With a sparse model: every original image → the undistorted one, with its mask."""

import logging
import os
import shutil
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_sph.errors import InputError, unwritable
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.stage import Cost, Job, Kept, Result, Stage
from colmap_sph.platforms.files import move_into_place
from colmap_sph.project.cameras import plain_camera
from colmap_sph.project.files import (
    make_dir,
    process_name,
    remove,
    scratch_folder,
    set_aside,
    whole_digest,
)
from colmap_sph.project.images.depth import ValueRange
from colmap_sph.project.images.reading import image_problem
from colmap_sph.project.sparse_model import cameras_of_images
from colmap_sph.project.state.ownership import undistorted_place
from colmap_sph.project.state.records import (
    altered_files,
    begin,
    read_record,
    vouch_when_on_disk,
    vouched_facts,
    whole_digests,
)
from colmap_sph.project.undistortion.image import ImageToUndistort, undistort
from colmap_sph.project.undistortion.originals import Originals
from colmap_sph.project.undistortion.process import ChildProcess
from colmap_sph.project.undistortion.rounding import rounding_of_original
from colmap_sph.project.wide.cutting import forget_places

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context

logger = logging.getLogger(__name__)

# Processor seconds and bytes on disk per pixel of the original image; largest bytes in use, also where it has more
# than 8 bits, and of a process.
_SECONDS = 0.06e-6
_FILE_BYTES = 1.0
_BYTES = 14.0
_DEEP_BYTES = 25.0
_PROCESS_BYTES = 120e6
# Of a view that is cut, per pixel of it: processor seconds, and bytes beside the wide image, as its places there
# are kept.
_VIEW_SECONDS = 0.16e-6
_VIEW_BYTES = 80.0

_thread = threading.local()
_children: list[ChildProcess] = []


@dataclass(frozen=True, eq=False)
class UndistortTask:
    """An image to undistort in a scratch folder, where it goes from there, and what vouches for it.

    Attributes
    ----------
    image : ImageToUndistort
    target, mask_target : Path
        The undistorted image in the workspace, and its mask.
    record : Path
    key : str
    is_doubted : bool
        Whether what is there does not count, though its record vouches for it.
    """

    image: ImageToUndistort
    target: Path
    mask_target: Path
    record: Path
    key: str
    is_doubted: bool = False

    @property
    def files(self) -> list[Path]:
        """What will be there."""
        return [self.target, self.mask_target] if self.image.has_mask else [self.target]


def make_undistorted_image(task: UndistortTask) -> Facts:
    """Undistort an image and its mask; writes both into the workspace."""
    # A process that was lost may still be at work on the same image.
    folder = task.image.folder / process_name()
    image = replace(task.image, folder=folder, mask_folder=folder / "masks")
    make_dir(image.mask_folder)
    try:
        if image.is_colmaps:
            _child(task.image.folder.parent).call(undistort, image, str(task.target))
        else:
            undistort(image)
        _publish(replace(task, image=image))
    except OSError as error:
        raise unwritable(task.target, error) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError):  # another process has not ended there
            task.image.folder.rmdir()
    return Facts()


def _publish(task: UndistortTask) -> None:
    """Move what was made into its place, and keep how coarsely the original was rounded: the copy does not say."""
    rounding = rounding_of_original(task.image.source)
    moves = {task.target: task.image.image_path}
    if task.image.has_mask:
        moves[task.mask_target] = task.image.mask_path
    else:
        _withdraw_mask(task)
    digests = {target: whole_digest(made) for target, made in moves.items()}
    begin(task.record, list(moves), sync=False)
    for target, made in moves.items():
        make_dir(target.parent)
        move_into_place(made, target)
    vouch_when_on_disk(task.record, task.key, digests, rounding)


def _withdraw_mask(task: UndistortTask) -> None:
    """Remove a mask that was made when the original image had one; what may be the user's gets another name."""
    if not task.mask_target.is_file():
        return
    known = read_record(task.record)
    if known is not None and known.state == "making":
        backup = set_aside(task.mask_target)
        logger.warning("%s may not be what this program wrote there; it is now %s", task.mask_target, backup.name)
    elif task.mask_target not in altered_files(known, [task.target, task.mask_target]):
        remove(task.mask_target)


def _child(folder: Path) -> ChildProcess:
    """The process for COLMAP of the current thread, and of the run whose scratch folder this is."""
    child: ChildProcess | None = getattr(_thread, "child", None)
    if child is None or child.folder != folder:
        child = ChildProcess(folder)
        _thread.child = child
        _children.append(child)
    return child


def end_child() -> None:
    """End the process for COLMAP of the current thread."""
    child: ChildProcess | None = getattr(_thread, "child", None)
    if child is not None:
        _children.remove(child)
        child.close()
        _thread.child = None


class UndistortStage(Stage[str, UndistortTask]):
    """Undistorts images of a sparse model.

    Parameters
    ----------
    context : Context
    originals : Originals
    digests : mapping of str to str
        Digest of the content of each original image that is good.
    values : mapping of str to ValueRange
        What becomes black and white, of each of them that has more than 8 bits.
    verify : bool
        Whether to look at every byte of what is there.
    """

    name = "undistort"
    make = staticmethod(make_undistorted_image)
    end_thread = staticmethod(end_child)

    @staticmethod
    def found(task: UndistortTask) -> Facts | None:
        """See `Stage.found`."""
        return None if task.is_doubted else vouched_facts(task.record, task.key, task.files, Facts)

    def __init__(
        self,
        context: "Context",
        originals: Originals,
        digests: Mapping[str, str],
        values: Mapping[str, ValueRange],
        *,
        verify: bool = False,
    ) -> None:
        super().__init__(context, originals.cuts.names(digests))
        self._originals = originals
        self._digests = digests
        self._values = values
        self._verify = verify
        self._cameras = cameras_of_images(originals.model)
        self._numbers = {name: number for number, name in enumerate(self.items)}

    def job(self, item: str) -> Job[UndistortTask]:
        """See `Stage.job`."""
        context = self.context
        workspace = context.workspace
        options = context.options.undistortion
        original, cut = self._originals.cuts.original(item), self._originals.cuts.views.get(item)
        camera = self._cameras[original] if cut is not None else plain_camera(self._cameras[original])
        field = None if cut is not None else self._originals.fields.get(camera.camera_id)
        values = self._values.get(original)
        mask = self._originals.mask_of(original)
        # Of its own for each image, as its name may be another's without the folders; and for each run, as the
        # process of one that was killed may still be at work.
        scratch = workspace.undistortion_scratch_dir / f"{os.getpid()}-{self._numbers[item]}"
        image = ImageToUndistort(
            self._originals.image_path(original),
            values,
            mask,
            camera,
            options,
            scratch,
            scratch / "masks",
            field,
            cut,
        )
        camera_parts = (camera.model_name, camera.width, camera.height, list(camera.params), field, cut)
        key = context.keys.undistorted(self._digests[original], camera_parts[: 5 + bool(cut)], values, mask)
        target = workspace.image_path(item)
        record = undistorted_place(workspace, item).record
        task = UndistortTask(
            image,
            target,
            workspace.made_mask_path(item),
            record,
            key,
            self._verify,
        )
        known = self._is_as_made(task) or self._is_changed_by_user(task)
        pixels = camera.width * camera.height
        seconds = _SECONDS * pixels
        memory = (_BYTES if values is None and field is None else _DEEP_BYTES) * pixels
        if cut is not None:
            pixels = cut.face.width * cut.face.height
            seconds = _VIEW_SECONDS * pixels
            memory += _VIEW_BYTES * pixels
        if image.is_colmaps:
            memory += _PROCESS_BYTES
        cost = Cost(seconds, memory, _FILE_BYTES * pixels)
        return Job(key, Facts() if known else None, cost, task)

    def _is_as_made(self, task: UndistortTask) -> bool:
        """Whether image and mask are there as they were made; with `verify` every byte of them is looked at."""
        files = task.files
        if vouched_facts(task.record, task.key, files, Facts) is None:
            return False
        return not self._verify or whole_digests(task.record, len(files)) == tuple(map(whole_digest, files))

    def _is_changed_by_user(self, task: UndistortTask) -> bool:
        """Whether an image was made and then exchanged for another good one, or its mask was: they are used.

        Not with `verify`: bit rot may look like that, too.
        """
        if self._verify:
            return False
        record = read_record(task.record)
        is_made = record is not None and (record.key, record.state) == (task.key, "done")
        if not is_made or not all(path.is_file() for path in task.files):
            return False
        if image_problem(task.target, *task.image.undistorted_size) is not None:
            return False
        logger.warning("%s or its mask was changed since this program made it; used as it is", task.target)
        return True

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Undistort in a folder of its own, which is there until this ends."""
        with scratch_folder(self.context.workspace.undistortion_scratch_dir):
            yield

    @contextmanager
    def holding(self, kept: Kept) -> Iterator[None]:
        """Keep the processes of COLMAP, and places in wide images, until the end."""
        try:
            yield
        finally:
            forget_places()
            folder = self.context.workspace.undistortion_scratch_dir
            for child in [child for child in _children if child.folder == folder]:
                _children.remove(child)
                child.close()

    def close(self, results: Mapping[str, Result]) -> None:
        """See `Stage.close`."""
        if not results:
            reason = min(self.context.report.skipped_images.items())[1]
            raise InputError(f"None of the images could be undistorted ({reason})")
