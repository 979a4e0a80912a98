"""Dense reconstruction for COLMAP without a GPU.

>>> import colmap_sph
>>> report = colmap_sph.run("sparse/0")  # doctest: +SKIP

The stages are modules of their own: `scene`, `pairs`, `rectification`, `matching`, `depth`, `normals`,
`workspace`, `fusion`; `pipeline` puts them in order.
"""

# pycolmap brings a zlib of its own; the first one loaded serves every module of the process, and with
# pycolmap's, Python's and OpenCV's PNG writers crash.
import zlib  # noqa: F401
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from colmap_sph.errors import ColmapSphError
    from colmap_sph.pipeline.options import RunOptions
    from colmap_sph.pipeline.reconstruct import reconstruct, run
    from colmap_sph.pipeline.report import Progress, RunReport

__all__ = ["ColmapSphError", "Progress", "RunOptions", "RunReport", "reconstruct", "run"]
__version__ = "0.1.0"

_MODULE_OF = {
    "ColmapSphError": "errors",
    "Progress": "pipeline.report",
    "RunOptions": "pipeline.options",
    "RunReport": "pipeline.report",
    "reconstruct": "pipeline.reconstruct",
    "run": "pipeline.reconstruct",
}


def __getattr__(name: str) -> Any:
    """Load a public name when it is first used: `colmap_sph.evaluation` alone must not load the pipeline."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
