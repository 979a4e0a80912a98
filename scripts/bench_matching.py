"""Our matcher against OpenCV's StereoSGBM (MODE_HH) on rectified pairs with known disparities.

    python scripts/bench_matching.py --pairs FOLDER [--output FILE]

Ours twice: with the options for a pair alone (`SINGLE_PAIR`), and with the pipeline's, where many pairs vote.

FOLDER holds a folder for each pair: ``left.png``, ``right.png``, and ``disparity.npz`` with the array
``disparity``, x_right = x_left - disparity, NaN where it is unknown. Without --pairs the shared test pairs are
taken (COLMAP_SPH_DATA, or ../shared/data beside the repository). All matchers get the same range, that of the
truth, and run on one thread. Pixels count whose true match lies inside the right image; *seen* are those that it
shows, since nothing nearer covers them. *Wrong* is further than one pixel from the truth, among what was matched.
*Locked* says how uneven the fractions of the matched disparities
are: the largest difference of a tenth of a pixel's share, relative to a tenth, from what the truth's have (of
use only where the truth is not itself in steps of a fraction of a pixel).
"""

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from benchmarking import machine, table
from numpy.typing import NDArray

from colmap_sph.stereo.census import RectifiedImage
from colmap_sph.stereo.matching import SINGLE_PAIR, MatchingOptions, match_pair

Image = NDArray[np.uint8]
_BLOCK = 3
_BINS = 10


@dataclass(frozen=True)
class Score:
    """Of one matcher on one pair: shares of the pixels with known disparity, and seconds."""

    matched: float
    wrong: float
    matched_seen: float
    wrong_seen: float
    median: float
    locked: float
    seconds: float


def ours(left: Image, right: Image, low: int, high: int, options: MatchingOptions) -> NDArray[np.float32]:
    """Disparities by `colmap_sph.matching`; NaN = none."""
    return match_pair(whole_image(left), whole_image(right), low, high, options)


def whole_image(image: Image) -> RectifiedImage:
    """A colour image in grey, content everywhere."""
    grey = np.asarray(cv2.cvtColor(image.astype(np.float32), cv2.COLOR_BGR2GRAY), dtype=np.float32)
    return RectifiedImage(grey, np.full(grey.shape, 255, np.uint8))


def opencv(left: Image, right: Image, low: int, high: int) -> NDArray[np.float32]:
    """Disparities by OpenCV with the settings of its own sample, 8 paths and colour; NaN = none."""
    count = -(-(high - low + 1) // 16) * 16
    matcher = cv2.StereoSGBM.create(
        minDisparity=low,
        numDisparities=count,
        blockSize=_BLOCK,
        P1=8 * 3 * _BLOCK**2,
        P2=32 * 3 * _BLOCK**2,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=32,
        preFilterCap=63,
        mode=cv2.StereoSGBM_MODE_HH,
    )
    # Beyond the left border nothing is matched unless the images are wider.
    wide = [cv2.copyMakeBorder(image, 0, 0, low + count, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    disparity = matcher.compute(*wide)[:, low + count :].astype(np.float32) / 16
    return np.where(disparity >= low, disparity, np.nan)


def seen_by_both(truth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels whose true match lies inside the right image, and whose place no pixel a step nearer takes there."""
    inside = np.isfinite(truth) & (np.arange(truth.shape[1]) >= np.nan_to_num(truth))
    row, column = np.nonzero(inside)
    disparity = truth[row, column]
    place = row, np.rint(column - disparity).astype(int)
    nearest = np.zeros_like(truth)
    np.maximum.at(nearest, place, disparity)
    seen = np.zeros_like(inside)
    seen[row, column] = disparity > nearest[place] - 1
    return seen


def score(found: NDArray[np.float32], truth: NDArray[np.float32], seconds: float) -> Score:
    """Compare with the truth where that is known and inside the right image."""
    known = np.isfinite(truth) & (np.arange(truth.shape[1]) >= np.nan_to_num(truth))
    matched = known & np.isfinite(found)
    seen = seen_by_both(truth)
    error = np.abs(found - truth)
    shares = [
        np.histogram(values[matched] % 1, bins=_BINS, range=(0, 1))[0] / max(matched.sum(), 1)
        for values in (found, truth)
    ]
    locked = float(np.max(np.abs(shares[0] - shares[1]) * _BINS))
    parts = [
        (float((matched & chosen).sum() / chosen.sum()), float((error[matched & chosen] > 1).mean()))
        for chosen in (known, seen)
    ]
    return Score(*parts[0], *parts[1], float(np.median(error[matched])), locked, seconds)


def measure(folder: Path) -> dict[str, Score]:
    """Scores of the matchers on the pair in `folder`."""
    left = cv2.imread(str(folder / "left.png"))
    right = cv2.imread(str(folder / "right.png"))
    with np.load(folder / "disparity.npz") as data:
        truth = data["disparity"]
    if left is None or right is None or left.shape[:2] != truth.shape:
        sys.exit(f"{folder}: left.png, right.png and the array in disparity.npz must be there and of one size.")
    low, high = int(np.floor(np.nanmin(truth))), int(np.ceil(np.nanmax(truth)))
    scores = {}
    matchers: dict[str, Callable[[Image, Image, int, int], NDArray[np.float32]]] = {
        "ours": partial(ours, options=SINGLE_PAIR),
        "OpenCV HH": opencv,
        "ours, to vote": partial(ours, options=MatchingOptions()),
    }
    for name, matcher in matchers.items():
        start = time.perf_counter()
        found = matcher(np.asarray(left, np.uint8), np.asarray(right, np.uint8), low, high)
        scores[name] = score(found, truth, time.perf_counter() - start)
    return scores


def main() -> None:
    """Match every pair, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(os.environ.get("COLMAP_SPH_DATA", Path(__file__).parents[2] / "shared" / "data"))
    parser.add_argument("--pairs", type=Path, default=default / "stereo_pairs")
    parser.add_argument("--output", type=Path, help="Markdown file to write, too")
    arguments = parser.parse_args()
    folders = sorted(path.parent for path in arguments.pairs.glob("*/disparity.npz"))
    if not folders:
        parser.error(f"{arguments.pairs} holds no pair: NAME/left.png, right.png, disparity.npz are needed.")
    cv2.setNumThreads(1)
    rows = []
    for folder in folders:
        for name, s in measure(folder).items():
            percent = [f"{100 * share:.2f} %" for share in (s.matched, s.wrong, s.matched_seen, s.wrong_seen)]
            rows.append(
                [folder.name, name, *percent, f"{s.median:.3f}", f"{100 * s.locked:.0f} %", f"{s.seconds:.2f}"]
            )
    header = ["pair", "matcher", "matched", "wrong of it", "matched, seen", "wrong, seen", "median error, px"]
    header += ["locked", "seconds"]
    text = f"{machine()}\n\n{table(header, rows)}\n"
    print(text)
    if arguments.output:
        arguments.output.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
