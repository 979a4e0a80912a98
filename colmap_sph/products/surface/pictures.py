"""A workspace → its images, brought to one brightness and colour."""

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_sph.products.surface.balance import balancing_gains
from colmap_sph.products.surface.seen import SeenView, read_picture
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene


class Pictures:
    """Images with their colours balanced, of which the latest are kept."""

    def __init__(
        self, workspace: Workspace, seen: Sequence[SeenView], gains: NDArray[np.float32], memory: int
    ) -> None:
        self._workspace = workspace
        self._seen = seen
        self._gains = gains
        self._memory = memory
        self._kept: OrderedDict[int, NDArray[np.uint8]] = OrderedDict()

    def of(self, index: int) -> NDArray[np.uint8]:
        """(H, W, 3) image of a view."""
        if index in self._kept:
            self._kept.move_to_end(index)
            return self._kept[index]
        picture = read_picture(self._workspace, self._seen[index].view)
        for colour, gain in enumerate(self._gains[index]):
            table = np.clip(np.rint(np.arange(256) * gain), 0, 255).astype(np.uint8)
            picture[..., colour] = table[picture[..., colour]]
        while self._kept and sum(each.nbytes for each in self._kept.values()) + picture.nbytes > self._memory:
            self._kept.popitem(last=False)
        if picture.nbytes <= self._memory:
            self._kept[index] = picture
        return picture


def pictures_of(
    workspace: Workspace, scene: Scene, seen: Sequence[SeenView], *, balance: bool, memory: int
) -> Pictures:
    """Images of these views, balanced or as they are, of which so many bytes are kept."""
    gains = np.ones((len(seen), 3), np.float32)
    if balance:
        gains = balancing_gains(workspace, scene, [each.index for each in seen])
    return Pictures(workspace, seen, gains, memory)
