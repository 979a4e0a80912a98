"""Sun, sky light, cast shadows, and highlights on request, the only part that depends on the viewer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from colmap_sph.synthetic.primitives import FloatArray, Surface
from colmap_sph.synthetic.rays import OrthographicRays, trace
from colmap_sph.synthetic.texture import Float32Array


@dataclass(frozen=True)
class ShadowMap:
    """Distance from the sun to the nearest shadow caster, on a grid across the sun's rays.

    Built by `ShadowMap.cast`; a point lies in shade if a caster is nearer to the sun.
    """

    axes: FloatArray
    corner: tuple[float, float]
    texel: float
    distance: Float32Array

    @classmethod
    def cast(cls, surfaces: Sequence[Surface], sun: npt.ArrayLike, extent: FloatArray, texel: float) -> ShadowMap:
        """Map of the shadows of all bounded surfaces.

        Parameters
        ----------
        surfaces : sequence of Surface
            Unbounded ones cast no shadow.
        sun : (3,) array_like
            Direction from the scene to the sun.
        extent : (M, 3) float64
            Points whose convex hull holds what may receive shadow.
        texel : float
            Grid step in metres.

        Returns
        -------
        ShadowMap
        """
        casters = [surface for surface in surfaces if surface.corners() is not None]
        down = -np.asarray(sun, dtype=np.float64) / np.linalg.norm(np.asarray(sun))
        right = np.cross(down, [0.0, 0.0, 1.0] if abs(down[2]) < 0.99 else [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(down, right), down])
        local = extent @ axes.T
        low, high = local.min(axis=0), local.max(axis=0)
        x = np.arange(low[0], high[0], texel)
        y = np.arange(low[1], high[1], texel)
        start = low[2] - 100.0
        origins = (
            axes[0][:, None, None] * x[None, None, :]
            + axes[1][:, None, None] * y[None, :, None]
            + (axes[2] * start)[:, None, None]
        )
        rays = OrthographicRays(x, y, origins, axes[2][:, None, None], axes)
        distance = (trace(casters, rays).distance + start).astype(np.float32)
        return cls(axes, (float(x[0]), float(y[0])), texel, distance)

    def lit(self, points: FloatArray, incidence: FloatArray) -> Float32Array:
        """Share of sunlight (N,) that reaches world points (3, N); edges one texel wide.

        `incidence` (N,) is the cosine between the surface's normal and the sun.
        """
        x, y, depth = np.einsum("ij,jn->in", self.axes, points)
        rows, columns = self.distance.shape
        x = np.clip((x - self.corner[0]) / self.texel, 0.0, columns - 1.001)
        y = np.clip((y - self.corner[1]) / self.texel, 0.0, rows - 1.001)
        i = x.astype(np.int64)
        j = y.astype(np.int64)
        fx = (x - i).astype(np.float32)
        fy = (y - j).astype(np.float32)
        # A slanted face must not shade itself: its own depth changes by this much from texel to texel.
        slope = np.sqrt(1.0 - np.minimum(incidence, 1.0) ** 2) / np.maximum(incidence, 0.1)
        limit = (depth - self.texel * (0.3 + 1.5 * slope)).astype(np.float32)
        flat = self.distance.ravel()
        place = j * columns + i
        corner = [flat[place + step] >= limit for step in (0, 1, columns, columns + 1)]
        top = corner[0] * (1 - fx) + corner[1] * fx
        bottom = corner[2] * (1 - fx) + corner[3] * fx
        share: Float32Array = top * (1 - fy) + bottom * fy
        return share


@dataclass(frozen=True)
class Light:
    """Sky light from everywhere plus a sun (Lambert's law): the same brightness from every side.

    Attributes
    ----------
    sun : (3,) tuple
        Direction towards the sun, any length.
    ambient, direct : float
        Share of the sky and of the sun at perpendicular incidence.
    shadows : ShadowMap, optional
        Shadows cast between surfaces; without it every face turned to the sun is lit.
    specular : float
        Brightness of the sun's mirror image on all surfaces, of 1; it moves with the viewer (Phong's model).
    shininess : float
        Exponent of the cosine between the mirrored ray and the sun: the larger, the smaller is the highlight.
    """

    sun: tuple[float, float, float] = (-0.45, -0.55, 0.85)
    ambient: float = 0.56
    direct: float = 0.66
    shadows: ShadowMap | None = None
    specular: float = 0.0
    shininess: float = 12.0

    def brightness(self, points: FloatArray, normals: FloatArray) -> Float32Array:
        """RGB factor (N, 3) at points (3, N) with outward unit normals (3, N)."""
        towards = np.asarray(self.sun) / np.linalg.norm(self.sun)
        incidence = np.maximum(np.einsum("i,in->n", towards, normals), 0.0)
        sunlight = incidence.astype(np.float32)
        if self.shadows is not None:
            sunlight *= self.shadows.lit(points, incidence)
        sky = np.array([0.94, 0.98, 1.06], dtype=np.float32) * np.float32(self.ambient)
        warm = np.array([1.03, 1.00, 0.93], dtype=np.float32) * np.float32(self.direct)
        factor: Float32Array = sky + sunlight[:, None] * warm
        return factor

    def highlight(self, points: FloatArray, normals: FloatArray, rays: FloatArray) -> Float32Array:
        """White (N, 1) that the sun's mirror image adds.

        Points, outward unit normals and viewing directions are (3, N).
        """
        towards = np.asarray(self.sun) / np.linalg.norm(self.sun)
        viewing = rays / np.linalg.norm(rays, axis=0)
        mirrored = viewing - 2.0 * np.sum(viewing * normals, axis=0) * normals
        incidence = np.maximum(np.einsum("i,in->n", towards, normals), 0.0)
        cosine = np.maximum(np.einsum("i,in->n", towards, mirrored), 0.0)
        white: Float32Array = (self.specular * cosine**self.shininess * (incidence > 0)).astype(np.float32)
        if self.shadows is not None:
            white *= self.shadows.lit(points, incidence)
        column: Float32Array = white[:, None]
        return column
