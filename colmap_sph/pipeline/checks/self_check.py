"""Agreement of depth maps with the sparse points → what to tell of it, and whether results make no sense."""

import logging
from collections.abc import Mapping
from statistics import median

import numpy as np

from colmap_sph.errors import NoResultError, percent
from colmap_sph.pipeline.report import RunReport
from colmap_sph.pipeline.stages.facts import Agreement
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.partners.frusta import sees
from colmap_sph.stereo.partners.pairing import Pair

logger = logging.getLogger(__name__)

# On sound input a third of the points agree at the very least (a fisheye rig among people), nearly all as a rule;
# of images that are turned, mirrored or exchanged a twentieth. An image is doubted below this share, ...
_DOUBTED_SHARE = 0.15
# ... and all of them below this one.
_REFUSED_SHARE = 0.1
# An image is doubted, too, where its points with a depth agree so much less often than those of the median image:
# of real scenes the worst has nine tenths of that, an image exchanged for its neighbour in the strip half.
_DOUBTED_OF_USUAL = 0.7
# Where points do not project to their observations in most images, sound depth would still agree with most points:
# so it does where only the observations are of another size.
_REFUSED_SHARE_OF_MISPLACED = 0.5
# Where so large a share of the points with a depth agrees, and of all, little was matched, but what was is right.
_RIGHT_SHARE_OF_FOUND = 0.5
_LEAST_SHARE = 0.05
# Fewer points say nothing of a run, and of an image.
_FEWEST = 30
_FEWEST_OF_IMAGE = 10
# Sparse points lie a pixel or so from their observations, be they ever so roughly adjusted.
_FAR_PIXELS = 4.0
_FAR_SHARE = 0.01
# Of the longer side, beyond what another size and crop explain: of sound models points lie a thousandth off.
_IMPOSSIBLE_SHARE = 0.03
# Points tell focal lengths to some thousandths, even of bent images; depth is wrong by as much as they are.
_OTHER_FOCAL_LENGTH = 0.03
_MAX_NAMED = 10
# A copy whose pose was found, too, has that of the image itself: within so much of the extent of all images, and
# so many radians.
_ONE_PLACE = 1e-3
_ONE_DIRECTION = 0.01
# Rows of pairs with good poses and lenses disagree by no more; by twice as much, the results suffer.
_EXPECTED_PIXELS = 0.2
_IMPRECISE_PIXELS = 0.4
_NAMED_WORST = 3


def judge_agreement(report: RunReport, *, misplaced: float, in_sight: float = 1.0) -> None:
    """Put into the report which images agree with few sparse points, or that hardly any image does.

    Parameters
    ----------
    report : RunReport
        With the agreement of its images.
    misplaced : float
        Share of the images in which sparse points do not project to their observations, see `judge_reprojection`.
    in_sight : float
        Share of the observed points that project into the images at all, see `share_in_sight`.
    """
    total = report.sparse_points
    is_enough = total.tested >= _FEWEST
    shares = {name: share for name, share in report.agreement.items() if share is not None}
    of_found = {name: share for name, share in report.agreement_of_found.items() if share is not None}
    usual = median(of_found.values()) if of_found else 0.0
    doubted = {
        name: share
        for name, share in shares.items()
        if share < _DOUBTED_SHARE or of_found.get(name, usual) < _DOUBTED_OF_USUAL * usual
    }
    if misplaced > 0.5 and in_sight < 0.5:
        report.refusal = _refusal_of_misplaced(f"only {percent(in_sight, 0)} of them into these images at all")
    elif not total.tested:
        logger.info("There are no sparse points to check the depth maps against")
    elif is_enough and misplaced > 0.5 and total.agreeing < _REFUSED_SHARE_OF_MISPLACED * total.tested:
        share = total.agreeing / total.tested
        report.refusal = _refusal_of_misplaced(f"only {percent(share)} of them agree with the depth maps")
    elif is_enough and total.agreeing < _REFUSED_SHARE * total.tested:
        is_right = total.agreeing >= _RIGHT_SHARE_OF_FOUND * total.found
        if is_right and total.agreeing >= _LEAST_SHARE * total.tested:
            add_doubt(report, _hardly_matched(total))
        else:
            report.refusal = _refusal(total)
    elif doubted:
        add_doubt(report, _doubts(doubted))


def misplaced_views(scene: Scene) -> dict[str, float]:
    """Images whose sparse points do not project to where they observe them, and by how many pixels (median)."""
    return {
        view.name: view.reprojection_error
        for view in scene.views
        if view.reprojection_error > max(_FAR_PIXELS, _FAR_SHARE * max(view.width, view.height))
        or _has_other_focal_length(view)
    }


def _has_other_focal_length(view: View) -> bool:
    """Whether its points project to where they are observed with other focal lengths than it has."""
    if view.focal_factors is None or len(view.point_indices) < _FEWEST_OF_IMAGE:
        return False
    return bool(np.abs(np.subtract(view.focal_factors, 1)).max() > _OTHER_FOCAL_LENGTH)


def judge_reprojection(report: RunReport, scene: Scene) -> float:
    """Warn of images whose sparse points do not project to where the model says that they observe them.

    Parameters
    ----------
    report : RunReport
        Gets the doubts.
    scene : Scene

    Returns
    -------
    float
        The share of such images, 0 to 1.
    """
    far = misplaced_views(scene)
    if far:
        shown = [f"{name} ({error:.0f} px)" for name, error in sorted(far.items(), key=lambda item: -item[1])]
        words = (
            f"Sparse points do not project to where these images observe them: {_named(shown)}. Cameras, poses or "
            "points were changed apart from each other, and depth is wrong where cameras or poses are; "
            "or the model's image coordinates are those of images of another size."
        )
        add_doubt(report, words)
    return len(far) / max(len(scene.views), 1)


def judge_copies(report: RunReport, scene: Scene, contents: Mapping[str, str]) -> None:
    """Warn of images that are the same file under other names, at other poses: only one of these can be right.

    Parameters
    ----------
    report : RunReport
        Gets the doubts.
    scene : Scene
    contents : mapping of str to str
        Name of an image → digest of its file.
    """
    same: dict[str, list[View]] = {}
    for view in scene.views:
        # What is cut from a wide image may be black in all of them.
        if view.name in contents and not view.original:
            same.setdefault(contents[view.name], []).append(view)
    near = _ONE_PLACE * float(np.linalg.norm(np.ptp([view.center for view in scene.views], axis=0)))
    copies = []
    for first, *others in same.values():
        apart = [view for view in others if not _is_one_pose(first, view, near)]
        copies += [", ".join(view.name for view in (first, *apart))] if apart else []
    if copies:
        add_doubt(
            report,
            f"These images are the same file under other names, but at other poses: {_named(copies, '; ')}. Only "
            "one of these poses can be right: give each image its own file, or remove the copies from the model.",
        )


def _is_one_pose(first: View, second: View, near: float) -> bool:
    turned = np.linalg.norm(first.R - second.R) / np.sqrt(2)  # radians, of small angles
    return bool(turned <= _ONE_DIRECTION and np.linalg.norm(first.center - second.center) <= near)


def refuse_cameras(scene: Scene) -> None:
    """Raise `NoResultError` where points contradict so many images that hours of work would be in vain.

    That is half of them with other focal lengths than their points have, or most with points that project far off.
    Not where the observations may be of another size or crop: depth may be right then, and is judged by itself.

    Parameters
    ----------
    scene : Scene
    """
    telling = [view for view in scene.views if len(view.point_indices) >= _FEWEST_OF_IMAGE]
    others = [view for view in telling if _has_other_focal_length(view)]
    if others and 2 * len(others) >= len(telling):
        fx, fy = np.median([view.focal_factors for view in others], axis=0)
        raise NoResultError(
            f"Sparse points do not project to where {len(others)} of {len(telling)} images observe them, but "
            f"would with {fx:.3g} times the horizontal and {fy:.3g} times the vertical focal length: cameras of "
            "the model are not those that its points were made with. Give the model as it was adjusted, with its "
            "cameras."
        )
    shares = [
        min(view.reprojection_error, view.unexplained_error) / max(view.width, view.height) for view in telling
    ]
    if 2 * sum(share > _IMPOSSIBLE_SHARE for share in shares) > len(shares):
        raise NoResultError(
            "Sparse points do not project to where most images observe them, and no other size or crop of the "
            f"images explains it: {percent(median(shares), 0)} of their longer side is left. Cameras, poses or "
            "points of the model were changed apart from each other; give the model as it was adjusted, with its "
            "cameras."
        )


def share_in_sight(scene: Scene) -> float:
    """Share of the points that images observe which project into them; 1 where these are too few to tell."""
    seen = [sees(view, scene.points[view.point_indices]) for view in scene.views]
    number = sum(map(len, seen))
    return sum(int(inside.sum()) for inside in seen) / number if number >= _FEWEST else 1.0


def judge_rows(report: RunReport, scene: Scene, residuals: Mapping[Pair, float | None]) -> None:
    """Put into the report how far the rows of pairs disagree, and what that means where it is much.

    Parameters
    ----------
    report : RunReport
    scene : Scene
    residuals : mapping of (str, str) to float or None
        Row residual of each pair, radians, as far as it is known.
    """
    of_images: dict[str, list[float]] = {}
    of_pairs = []
    report.matched_pairs = []
    for names, residual in residuals.items():
        if residual is None:
            report.matched_pairs.append((*names, None))
            continue
        pixels = [residual * float(scene.view(name).K[0, 0]) for name in names]
        of_pairs.append(max(pixels))
        report.matched_pairs.append((*names, round(of_pairs[-1], 3)))
        for name, value in zip(names, pixels, strict=True):
            of_images.setdefault(name, []).append(value)
    if not of_pairs:
        return
    report.row_residual = round(median(of_pairs), 3)
    report.row_residuals = {name: round(median(values), 3) for name, values in sorted(of_images.items())}
    logger.info("Rows of pairs disagree by %.2f pixels (median of %d)", report.row_residual, len(of_pairs))
    if report.row_residual > _IMPRECISE_PIXELS:
        worst = sorted(report.row_residuals.items(), key=lambda item: -item[1])[:_NAMED_WORST]
        report.imprecision = (
            f"Rows of pairs disagree by {report.row_residual:.2f} pixels ({_EXPECTED_PIXELS} expected): poses or "
            "lens models are imprecise, and tolerances are wider by that. Most in "
            + ", ".join(f"{name} ({value:.2f})" for name, value in worst)
            + "."
        )
        logger.warning("%s", report.imprecision)


def refuse_disagreement(report: RunReport) -> None:
    """Raise `NoResultError` where hardly any sparse point agrees with the depth maps."""
    if report.refusal:
        raise NoResultError(report.refusal)


def add_doubt(report: RunReport, words: str) -> None:
    """Put one more sentence into what the report doubts."""
    report.doubts = f"{report.doubts} {words}".strip()
    logger.warning("%s", words)


def _refusal(total: Agreement) -> str:
    return (
        f"Only {percent(total.agreeing / total.tested)} of the sparse points agree with the depth maps of the "
        "images that observe them: these images do not belong to the poses and cameras of the model (exchanged, "
        "turned, mirrored, cropped, or of another model), or hardly anything could be matched; check --images. "
        "What was made is left on disk."
    )


def _refusal_of_misplaced(fact: str) -> str:
    return (
        f"Sparse points do not project to where most images observe them, and {fact}: cameras or poses of the "
        "model are not those that its points were made with. Give the model as it was adjusted, with its cameras. "
        "What was made is left on disk."
    )


def _hardly_matched(total: Agreement) -> str:
    return (
        f"Hardly anything could be matched: only {percent(total.found / total.tested)} of the sparse points that "
        f"the images observe have a depth, of which {percent(total.agreeing / total.found, 0)} agree."
    )


def _doubts(doubted: Mapping[str, float]) -> str:
    shares = sorted((share, name) for name, share in doubted.items())
    named = _named([f"{name} ({percent(share, 0)})" for share, name in shares])
    return (
        "Few of the sparse points that these images observe agree with their depth maps, or far fewer than in the "
        f"other images: {named}. Their poses, cameras or pixels may not be those of the model, or they could "
        "hardly be matched."
    )


def _named(names: list[str], between: str = ", ") -> str:
    more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
    return between.join(names[:_MAX_NAMED]) + more
