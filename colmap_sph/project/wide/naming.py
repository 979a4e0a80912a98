"""What is said of views cut from wide images → the same by the names of the images that a user gave."""

from collections.abc import Mapping, Sequence


def by_originals(reasons: Mapping[str, str], views: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Say of an image what is said of all its views; of one of several views, from which image it is.

    Parameters
    ----------
    reasons : mapping of str to str
        By the names of images and views.
    views : mapping of str to sequence of str
        Names of the views of each wide image.

    Returns
    -------
    dict of str to str
        In the same order.

    Examples
    --------
    >>> views = {"a.jpg": ["left/a.png", "right/a.png"], "b.jpg": ["left/b.png", "right/b.png"]}
    >>> by_originals({"left/a.png": "no pair", "right/a.png": "no pair", "left/b.png": "damaged"}, views)
    {'a.jpg': 'no pair', 'left/b.png (of b.jpg)': 'damaged'}
    """
    original_of = {view: original for original, names in views.items() for view in names}
    told: dict[str, str] = {}
    for name, reason in reasons.items():
        original = original_of.get(name)
        if original is None:
            told[name] = reason
        elif all(view in reasons for view in views[original]):
            told[original] = "; ".join(dict.fromkeys(reasons[view] for view in views[original]))
        else:
            told[f"{name} (of {original})"] = reason
    return told
