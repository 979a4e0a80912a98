"""Which version of the compiled kernels is used; all versions give the same results to the bit."""

import os

from colmap_sph import _native
from colmap_sph.errors import OptionError


def backend() -> str:
    """Name of the kernels in use: the fastest this processor has, or what COLMAP_SPH_KERNELS asks for."""
    wanted = os.environ.get("COLMAP_SPH_KERNELS")
    available: list[str] = _native.backends()
    if wanted and wanted not in available:
        raise OptionError(f"COLMAP_SPH_KERNELS={wanted}: this processor has {', '.join(available)}.")
    return wanted or available[0]
