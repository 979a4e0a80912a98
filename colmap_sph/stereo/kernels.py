"""Which version of the compiled kernels is used; all versions give the same results to the bit."""

import logging
import os

from colmap_sph import _native
from colmap_sph.errors import OptionError

logger = logging.getLogger(__name__)


def backend() -> str:
    """Name of the kernels in use: the fastest this processor has, or what COLMAP_SPH_KERNELS asks for."""
    wanted = os.environ.get("COLMAP_SPH_KERNELS")
    available: list[str] = _native.backends()
    if wanted and wanted not in available:
        raise OptionError(f"COLMAP_SPH_KERNELS={wanted}: this processor has {', '.join(available)}.")
    return wanted or available[0]


def shortcoming() -> str:
    """What this build's kernels lack, in a sentence; empty where they are whole."""
    # In a checkout the folder of the kernels' sources is what is imported: it has nothing.
    missing: list[str] = _native.missing() if hasattr(_native, "missing") else []
    if not missing:
        return ""
    return (
        f"This build of colmap_sph has no kernels for {' and '.join(missing)}: results are the same, but may take "
        "several times longer. Install a wheel, or build it anew with a newer gcc or clang."
    )


if _words := shortcoming():
    logger.warning("%s", _words)
