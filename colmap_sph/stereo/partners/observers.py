"""What each photograph observes → who observes each point."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def observers_of_points(
    observed: Sequence[NDArray[np.int64]], num_points: int
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Turn what each photograph or view observes into who observes each point.

    Parameters
    ----------
    observed : sequence of (n,) int64 ndarray
        For each of V the rows of the points that it observes.
    num_points : int
        N.

    Returns
    -------
    first : (N + 1,) int64 ndarray
        Where the observers of each point begin, and where the last one's end.
    observers : (M,) int32 ndarray
        Those of one point after the other, ascending.

    Examples
    --------
    >>> import numpy as np
    >>> first, observers = observers_of_points([np.array([0, 2]), np.array([2])], 3)
    >>> first.tolist(), observers.tolist()
    ([0, 1, 1, 3], [0, 0, 1])
    """
    rows = np.concatenate([*observed, np.empty(0, np.int64)])
    observer = np.repeat(np.arange(len(observed)), np.array([len(each) for each in observed], np.int64))
    first = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=num_points))])
    # A point and its observer as one number: to sort these is faster than to order one by the other.
    by_point = np.sort(rows * len(observed) + observer)
    return first, (by_point % max(len(observed), 1)).astype(np.int32)
