"""COLMAP's ``database.db``: found beside a model, and the verified matches in it."""

import sqlite3
from pathlib import Path

from colmap_sph.errors import InputError, reason_of
from colmap_sph.project.files import real_path

# COLMAP numbers a pair `image_id1 * 2147483647 + image_id2`.
_MAX_NUM_IMAGES = 2147483647


def find_database(model_dir: Path) -> Path | None:
    """COLMAP's ``database.db`` beside or above the model, if there is one."""
    # Of a link to a model where it leads to, that is beside which it was made, and then where it is.
    folders = [model_dir, *real_path(model_dir).parents[:2], *(Path.cwd() / model_dir).parents[:2]]
    return next((f / "database.db" for f in folders if (f / "database.db").is_file()), None)


def read_verified_matches(database: Path) -> dict[tuple[str, str], int]:
    """Read how many verified matches each pair of images has.

    By SQLite itself, read-only: COLMAP's own class would create a missing database and migrate an old one.

    Parameters
    ----------
    database : Path

    Returns
    -------
    dict
        Names of two images → number of their matches, above 0.

    Raises
    ------
    InputError
        The file cannot be read, or is not a COLMAP database.
    """
    try:
        connection = sqlite3.connect(f"{real_path(database).as_uri()}?mode=ro", uri=True)
        try:
            name_of = dict(connection.execute("SELECT image_id, name FROM images"))
            rows = connection.execute("SELECT pair_id, rows FROM two_view_geometries WHERE rows > 0").fetchall()
        finally:
            connection.close()
    except sqlite3.Error as error:
        raise InputError(
            f"The database {database} cannot be read ({reason_of(error)}); give a COLMAP database or none."
        ) from error
    matches = {}
    for pair_id, count in rows:
        first, second = divmod(pair_id, _MAX_NUM_IMAGES)
        if first in name_of and second in name_of:
            matches[name_of[first], name_of[second]] = count
    return matches
