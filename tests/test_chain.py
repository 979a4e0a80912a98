"""Rendered views through rectification, matching, depth, consistency and normals, against their exact geometry."""

from itertools import combinations

import numpy as np
import pytest
from rendered import SIDES, grey, scene_of

from colmap_sph import synthetic as syn
from colmap_sph.stereo.census import RectifiedImage
from colmap_sph.stereo.confirm import ConfirmOptions, confirm_depth
from colmap_sph.stereo.matching import MatchingOptions, match_pair
from colmap_sph.stereo.normals import NormalOptions, fit_normals
from colmap_sph.stereo.rectification import RectificationOptions, rectify_pair
from colmap_sph.stereo.rectified_pair import PairDisparity
from colmap_sph.stereo.resampling import resample
from colmap_sph.stereo.vote import VoteOptions, vote_depth

SIZE = (240, 180)
FOCAL = 300.0
BASELINE = 1.5


def reconstruct(surfaces, light, cameras):
    """Geometric depth and normals of every view, matched in all pairs."""
    scene = scene_of(surfaces, cameras)
    pictures = {
        view.name: grey(syn.render(surfaces, c.K, c.R, c.t, c.width, c.height, light=light))
        for view, c in zip(scene.views, cameras, strict=True)
    }
    pairs = []
    for left, right in combinations(scene.views, 2):
        pair = rectify_pair(scene, left, right, RectificationOptions())
        images = [
            RectifiedImage(*resample(pictures[view.name], view, pair, side))
            for view, side in zip((left, right), SIDES, strict=True)
        ]
        disparity = match_pair(images[0], images[1], pair.min_disparity, pair.max_disparity, MatchingOptions())
        pairs.append(PairDisparity(left.name, right.name, pair, disparity))
    own = {
        view.name: vote_depth(view, [p for p in pairs if view.name in (p.left, p.right)], VoteOptions())
        for view in scene.views
    }
    results = []
    for view in scene.views:
        partners = [(other, own[other.name]) for other in scene.views if other is not view]
        confirmed = confirm_depth(view, own[view.name], partners, ConfirmOptions())
        normals, fitted = fit_normals(view, confirmed, NormalOptions())
        confirmed.depth[fitted == 0] = 0
        results.append((confirmed, normals))
    return results


def shifted(camera, x, y):
    return syn.Camera(camera.K, camera.R, camera.t - np.array([x, y, 0.0]), camera.width, camera.height)


@pytest.mark.parametrize(("slant", "tilt"), [(0, 0), (30, 90), (45, 45), (60, 0)])
def test_planes_come_out_at_their_place_with_their_normals(slant, tilt):
    """Depth at COLMAP's pixel origin: half a pixel's shift would be seen as half a pixel along the slope."""
    pair = syn.slanted_plane_pair(slant, tilt, focal_length=FOCAL, size=SIZE)
    middle = pair.left
    cameras = [middle, *(shifted(middle, *place) for place in ((-BASELINE, 0), (BASELINE, 0.1), (0.1, BASELINE)))]
    estimate, normals = reconstruct(pair.surfaces, pair.light, cameras)[0]
    truth, true_normals, _ = syn.exact_geometry(pair.surfaces, middle, origin=0.0)
    found = estimate.depth > 0
    assert found.mean() > 0.75
    disparity_error = FOCAL * BASELINE * (1 / estimate.depth[found] - 1 / truth[found])
    assert np.median(np.abs(disparity_error)) < 0.1
    assert abs(np.median(disparity_error)) < 0.03
    cosine = (normals * true_normals).sum(axis=-1)
    assert (cosine[found] > np.cos(np.radians(10))).mean() > 0.94
    if slant >= 30:
        along = np.hypot(*np.gradient(truth))
        pixels_off = (estimate.depth - truth)[found] / along[found]
        assert abs(np.median(pixels_off)) < 0.25


def test_a_scene_with_occlusions_comes_out_whole():
    pair = syn.convergent_pair(12.0, focal_length=FOCAL, size=SIZE)
    target = np.array([0.0, 8.0, 1.2])
    centre = (pair.left.centre + pair.right.centre) / 2
    cameras = [pair.left, pair.right]
    for offset in ((0, 0, 0.9), (0, 0, -0.7)):
        R, t = syn.look_at(centre + offset, target)
        cameras.append(syn.Camera(pair.left.K, R, t, *SIZE))
    shares = []
    for (estimate, normals), camera in zip(reconstruct(pair.surfaces, pair.light, cameras), cameras, strict=True):
        truth, true_normals, _ = syn.exact_geometry(pair.surfaces, camera, origin=0.0)
        found = (estimate.depth > 0) & (truth > 0)
        error = np.abs(estimate.depth / truth - 1)[found]
        cosine = (normals * true_normals).sum(axis=-1)[found]
        shares.append(
            (found.mean(), (error < 0.01).mean(), (cosine > np.cos(np.radians(10))).mean(), np.median(error))
        )
    coverage, right, oriented, typical = np.mean(shares, axis=0)
    assert coverage > 0.7 and right > 0.9 and oriented > 0.7 and typical < 0.003
