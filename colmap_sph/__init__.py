"""Dense reconstruction for COLMAP without a GPU.

>>> import colmap_sph
>>> report = colmap_sph.run("sparse/0")  # doctest: +SKIP

The stages are modules of their own: `scene`, `pairs`, `rectification`, `matching`, `depth`, `normals`,
`workspace`, `fusion`; `pipeline` puts them in order.
"""

# pycolmap brings a zlib of its own; the first one loaded serves every module of the process, and with
# pycolmap's, Python's and OpenCV's PNG writers crash.
import zlib  # noqa: F401

from colmap_sph.errors import ColmapSphError
from colmap_sph.options import RunOptions
from colmap_sph.pipeline import reconstruct, run
from colmap_sph.report import Progress, RunReport

__all__ = ["ColmapSphError", "Progress", "RunOptions", "RunReport", "reconstruct", "run"]
__version__ = "0.1.0"
