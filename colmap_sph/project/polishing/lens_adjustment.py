"""Tracks, poses and cameras → the lens fields that explain them best, adjusted together with poses and points.

Fields and poses explain much of the same (a block that is domed hides a radial field), so that adjusting one after
the other hardly moves: this is one adjustment of all by Gauss and Newton, with the points eliminated. What a turn
of the camera and another focal length do to an image is no part of a field: these would change with it and nothing
would tell.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.sparse import block_array, csr_array, diags_array, eye_array, hstack, kron, vstack
from scipy.spatial.transform import Rotation

from colmap_sph.project.lens.field import Float, LensField

# Cells along each side of a field. Its coefficients may bend by so many pixels from cell to cell where
# nothing else is known; by how few it may be turned or scaled.
_CELLS = 8
_BEND = 1.0
_NO_TURN = 1e-3
# What poses and points can explain but for so small a share is left to them: it needs no lens, and other errors
# that images have in common (a rolling shutter) would fill it.
_MODESTY = 0.003
_NODES = 25
_STEPS = 12
_CONVERGED = 1e-4
# Of the diagonal: leaves where and how large the whole model is as it was.
_DAMPING = 1e-6
_POSE = 6
# Points whose equations are reduced at a time.
_CHUNK = 2000


@dataclass(frozen=True, eq=False)
class Sights:
    """Observations of points by images.

    Attributes
    ----------
    track, image : (m,) int64 ndarray
        Indices of point and image of each observation; tracks ascending.
    rays : (m, 2) float64 ndarray
        Where the camera model sees the point: (x, y) at z = 1.
    """

    track: NDArray[np.int64]
    image: NDArray[np.int64]
    rays: Float


@dataclass(frozen=True, eq=False)
class Bundle:
    """Poses, points and fields that explain some sights.

    Attributes
    ----------
    R, t : (n, 3, 3) and (n, 3) float64 ndarray
        World to camera.
    points : (p, 3) float64 ndarray
    fields : tuple of LensField
        On grids of the same size.
    field_of : (n,) int64 ndarray
        Index of the field of each image; -1 without any.
    focal : (n,) float64 ndarray
        Pixels: makes residuals of rays those of images.
    """

    R: Float
    t: Float
    points: Float
    fields: tuple[LensField, ...]
    field_of: NDArray[np.int64]
    focal: Float

    @property
    def coefficients(self) -> Float:
        """(2, c) of x and y of all fields."""
        return np.concatenate([field.coefficients.reshape(2, -1) for field in self.fields], axis=1)

    def with_coefficients(self, coefficients: Float) -> tuple[LensField, ...]:
        """Its fields with (2, c) others."""
        parts = np.split(coefficients, len(self.fields), axis=1)
        return tuple(
            replace(field, coefficients=part.reshape(field.coefficients.shape))
            for field, part in zip(self.fields, parts, strict=True)
        )


def fitted_fields(sights: Sights, start: Bundle, usual_error: float) -> Bundle:
    """Adjust poses, points and lens fields.

    Parameters
    ----------
    sights : Sights
    start : Bundle
    usual_error : float
        Pixels: residuals beyond it count linearly.

    Returns
    -------
    Bundle
    """
    bundle = start
    basis = _basis(sights, start)
    prior = _priors(start)
    cost = np.inf
    for _ in range(_STEPS):
        residuals = _Residuals.of(sights, bundle, basis, usual_error)
        if not residuals.cost < (1 - _CONVERGED) * cost:
            break
        cost = residuals.cost
        bundle = _step(sights, bundle, basis, residuals, prior)
    return bundle


def empty_field(low: Float, high: Float) -> LensField:
    """A field without displacements on a domain of rays."""
    return LensField.zero(low, high, (_CELLS, _CELLS))


@dataclass(frozen=True, eq=False)
class _Residuals:
    """What is left of each observation, weighted: pixels.

    Attributes
    ----------
    left : (m, 2) float64 ndarray
    in_camera : (m, 3) float64 ndarray
        Points in the frames of their cameras.
    scale : (m,) float64 ndarray
        Of a ray's derivatives: focal length and root of the weight; 0 of points that are not in front.
    cost : float
    """

    left: Float
    in_camera: Float
    scale: Float
    cost: float

    @classmethod
    def of(cls, sights: Sights, bundle: Bundle, basis: csr_array, usual_error: float) -> "_Residuals":
        focal = bundle.focal[sights.image]
        points = bundle.points[sights.track]
        in_camera = np.einsum("mij,mj->mi", bundle.R[sights.image], points) + bundle.t[sights.image]
        in_front = in_camera[:, 2] > 0
        in_camera[~in_front] = (0, 0, 1)
        left = sights.rays + basis @ bundle.coefficients.T - in_camera[:, :2] / in_camera[:, 2:]
        square = focal**2 * (left**2).sum(axis=1) / usual_error**2
        scale = np.where(in_front, focal * (1 + square) ** -0.25, 0)
        cost = float((2 * usual_error**2 * (np.sqrt(1 + square) - 1))[in_front].sum())
        return cls(left * scale[:, None], in_camera, scale, cost)


def _step(sights: Sights, bundle: Bundle, basis: csr_array, residuals: _Residuals, prior: Float) -> Bundle:
    """One step of Gauss and Newton."""
    parts = _parts(sights, bundle, basis, residuals)
    normal, right = _reduced(parts, len(bundle.R))
    number = _POSE * len(bundle.R)
    observed = diags_array(residuals.scale) @ basis
    prior = prior + _MODESTY * block_diag(*[(observed.T @ observed).toarray()] * 2)
    normal[number:, number:] += prior
    right[number:] -= prior @ bundle.coefficients.ravel()
    diagonal = np.einsum("ii->i", normal)
    diagonal += _DAMPING * diagonal + 1e-12 * diagonal.max()
    step = cho_solve(cho_factor(normal, lower=True, overwrite_a=True), right)
    turn, shift = np.split(step[:number].reshape(-1, _POSE), 2, axis=1)
    turned = np.asarray(Rotation.from_rotvec(turn).as_matrix())
    return replace(
        bundle,
        R=turned @ bundle.R,
        t=np.einsum("nij,nj->ni", turned, bundle.t) + shift,
        points=bundle.points + np.concatenate([part.moved(step) for part in parts]),
        fields=bundle.with_coefficients(bundle.coefficients + step[number:].reshape(2, -1)),
    )


def _derivatives(sights: Sights, bundle: Bundle, residuals: _Residuals) -> tuple[Float, Float]:
    """(m, 2, 6) of the projections by turn and shift of the pose, and (m, 2, 3) by the point; weighted."""
    x, y, z = residuals.in_camera.T
    zero = np.zeros_like(x)
    by_shift = np.stack([np.stack([1 / z, zero, -x / z**2], 1), np.stack([zero, 1 / z, -y / z**2], 1)], axis=1)
    by_shift *= residuals.scale[:, None, None]
    cross = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    return np.concatenate([by_shift @ cross, by_shift], axis=2), by_shift @ bundle.R[sights.image]


@dataclass(frozen=True, eq=False)
class _Part:
    """Equations of some points, in whose rows first x and then y of each observation stand.

    Attributes
    ----------
    points : slice
    others : csr_array
        Derivatives by poses and fields.
    whitened : csr_array
        Derivatives by the points, in coordinates in which their normal equations are 1.
    whitening : (p, 3, 3) float64 ndarray
        From these coordinates to those of the points.
    left : (rows,) float64 ndarray
    """

    points: slice
    others: csr_array
    whitened: csr_array
    whitening: Float
    left: Float

    def moved(self, step: Float) -> Float:
        """(p, 3) steps of the points where poses and fields make theirs."""
        rest = np.asarray(self.whitened.T @ (self.left - self.others @ step))
        return np.asarray(np.einsum("pij,pj->pi", self.whitening, rest.reshape(-1, 3)))


def _reduced(parts: Sequence[_Part], number: int) -> tuple[Float, Float]:
    """Normal equations of poses (`number` of them) and fields, without the points: matrix and right side."""
    size = parts[0].others.shape[1]
    poses = _POSE * number
    normal = np.zeros((size, size))
    right = np.zeros(size)
    for part in parts:
        mixed = (part.others.T @ part.whitened).tocsr()
        right += part.others.T @ part.left - mixed @ (part.whitened.T @ part.left)
        normal += (part.others.T @ part.others).toarray()
        # Poses share points with few others, fields with most.
        of_poses = mixed[:poses]
        of_field = mixed[poses:].toarray()
        normal[:poses, :poses] -= (of_poses @ of_poses.T).toarray()
        normal[poses:, poses:] -= of_field @ of_field.T
        normal[poses:, :poses] -= (of_poses @ of_field.T).T
    normal[:poses, poses:] = normal[poses:, :poses].T
    return normal, right


def _parts(sights: Sights, bundle: Bundle, basis: csr_array, residuals: _Residuals) -> list[_Part]:
    of_poses, of_points = _derivatives(sights, bundle, residuals)
    of_field = -diags_array(residuals.scale) @ basis
    number = len(bundle.points)
    starts = np.searchsorted(sights.track, np.arange(0, number + _CHUNK, _CHUNK))
    parts = []
    for first, (start, end) in zip(range(0, number, _CHUNK), pairwise(starts), strict=False):
        points = slice(first, min(first + _CHUNK, number))
        some = slice(start, end)
        track = sights.track[some] - first
        whitening = _whitening(of_points[some], track, points.stop - first)
        whitened = of_points[some] @ whitening[track]
        field = of_field[some]
        poses = [_sparse(of_poses[some, axis], sights.image[some], len(bundle.R)) for axis in (0, 1)]
        parts.append(
            _Part(
                points,
                block_array([[poses[0], field, None], [poses[1], None, field]], format="csr"),
                vstack([_sparse(whitened[:, axis], track, len(whitening)) for axis in (0, 1)], format="csr"),
                whitening,
                residuals.left[some].T.ravel(),
            )
        )
    return parts


def _whitening(of_points: Float, track: NDArray[np.int64], number: int) -> Float:
    """(number, 3, 3) inverse transposed Cholesky factors of the points' normal equations."""
    normal = np.zeros((number, 3, 3))
    np.add.at(normal, track, of_points.swapaxes(1, 2) @ of_points)
    # Rays that are nearly parallel leave a distance where it is; a point that nobody sees stays.
    trace = np.trace(normal, axis1=1, axis2=2)
    normal += (1e-9 * trace + (trace <= 0))[:, None, None] * np.eye(3)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(normal)).swapaxes(1, 2))


def _sparse(values: Float, block: NDArray[np.int64], number: int) -> csr_array:
    """(n, w * number) matrix whose rows hold (n, w) values in their blocks of columns."""
    width = values.shape[1]
    columns = width * block[:, None] + np.arange(width)
    starts = np.arange(0, values.size + 1, width)
    return csr_array((values.ravel(), columns.ravel(), starts), shape=(len(values), width * number))


def _basis(sights: Sights, bundle: Bundle) -> csr_array:
    """(m, c) what each coefficient of each field adds to the ray of each observation."""
    field_of = bundle.field_of[sights.image]
    size = bundle.fields[0].coefficients[0].size
    rows = [np.flatnonzero(field_of < 0)]
    parts = [csr_array((len(rows[0]), size * len(bundle.fields)))]
    for number, field in enumerate(bundle.fields):
        rows.append(np.flatnonzero(field_of == number))
        basis = field.basis(sights.rays[rows[-1]])
        before, after = size * number, size * (len(bundle.fields) - number - 1)
        sides = [csr_array((len(rows[-1]), width)) for width in (before, after)]
        parts.append(hstack([sides[0], basis, sides[1]], format="csr"))
    return vstack(parts, format="csr")[np.argsort(np.concatenate(rows))]


def _priors(bundle: Bundle) -> Float:
    """What is known of all coefficients beforehand, as normal equations; x of all fields first, then y."""
    size = bundle.fields[0].coefficients[0].size
    total = size * len(bundle.fields)
    priors = np.zeros((2 * total, 2 * total))
    for number, field in enumerate(bundle.fields):
        of_field = size * number + np.arange(size)
        index = np.concatenate([of_field, total + of_field])
        focal = float(np.median(bundle.focal[bundle.field_of == number]))
        priors[np.ix_(index, index)] = _prior(field, focal)
    return priors


def _prior(field: LensField, focal: float) -> Float:
    """What is known of coefficients beforehand, as normal equations: a field is smooth, and no turn or scale."""
    rows, columns = field.coefficients.shape[1:]
    along, across = (_differences(number, 2) for number in (columns, rows))
    twist = kron(_differences(rows, 1), _differences(columns, 1)) * np.sqrt(2)
    bends = vstack([kron(eye_array(rows), along), kron(across, eye_array(columns)), twist]).tocsr()
    smooth = (bends.T @ bends).toarray() * (focal / _BEND) ** 2
    rays = field.nodes(_NODES)
    basis = field.basis(rays)
    no_turns = np.stack([(basis.T @ turn).T.ravel() / np.linalg.norm(turn) for turn in _turns(rays)])
    no_turns *= focal / (_NO_TURN * _NODES)
    return np.asarray(block_diag(smooth, smooth) + no_turns.T @ no_turns)


def _differences(number: int, order: int) -> csr_array:
    """Matrix of the differences of so many values, taken `order` times."""
    return csr_array(np.diff(np.eye(number), order, axis=0))


def _turns(rays: Float) -> list[Float]:
    """What turns of the camera about its axes, and another focal length, do to rays: (n, 2) each."""
    x, y = rays.T
    return [np.stack(turn, axis=1) for turn in ((1 + x * x, x * y), (x * y, 1 + y * y), (-y, x), (x, y))]
