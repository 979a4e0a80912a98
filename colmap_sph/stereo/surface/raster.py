"""A raster over a scene: what its cells are called, and where they lie."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View


@dataclass(frozen=True, eq=False)
class Raster:
    """Square cells of a plane through a scene, and heights above it.

    Places are counted along the raster's own axes: to the right, to the top and upwards, in its units (metres of a
    map, say), as 64-bit floats. A cell is its column and its row, counted downwards from the upper left one; whole
    numbers are centres of cells.

    Attributes
    ----------
    matrix : (3, 3) float64 ndarray
        Scene → places: the raster's axes in its rows, times units of the raster per unit of the scene.
    offset : (3,) float64 ndarray
        Place of the scene's origin.
    left, top : float
        Place of the outer corner of the upper left cell.
    cell : float
        Side of a cell.
    width, height : int
        Columns and rows.
    """

    matrix: NDArray[np.float64]
    offset: NDArray[np.float64]
    left: float
    top: float
    cell: float
    width: int
    height: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.height, self.width

    @property
    def scale(self) -> float:
        """Units of the raster per unit of the scene."""
        return float(np.cbrt(np.linalg.det(self.matrix)))

    def window(self, row: int, column: int, height: int, width: int) -> "Raster":
        """The part that begins at this row and column, which may reach beyond the raster's borders."""
        return replace(
            self,
            left=self.left + column * self.cell,
            top=self.top - row * self.cell,
            width=width,
            height=height,
        )

    def finer(self, factor: int) -> "Raster":
        """The same extent with `factor` × `factor` cells for each one."""
        return replace(self, cell=self.cell / factor, width=self.width * factor, height=self.height * factor)

    @property
    def cells_from_scene(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(3, 3) matrix and (3,) shift from points of the scene to column, row and height."""
        steps = np.array([1 / self.cell, -1 / self.cell, 1.0])
        corner = np.array([self.left + self.cell / 2, self.top - self.cell / 2, 0.0])
        return steps[:, None] * self.matrix, steps * (self.offset - corner)

    def cells_from_camera(self, view: View) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The same from points in a view's camera frame."""
        matrix, shift = self.cells_from_scene
        return matrix @ view.R.T, matrix @ view.center + shift

    def to_cells(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(…, 3) points of the scene → columns, rows and heights."""
        matrix, shift = self.cells_from_scene
        return np.asarray(points @ matrix.T + shift)
