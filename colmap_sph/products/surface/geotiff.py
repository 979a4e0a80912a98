"""Tiles → cloud-optimised GeoTIFFs, by GDAL."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, OptionError, OutputError, reason_of
from colmap_sph.products.surface.tiles import Tile
from colmap_sph.stereo.surface.raster import Raster

NO_HEIGHT = -9999.0
_BLOCK = 256
_CACHE = 64 << 20  # bytes, in which rasterio, unlike GDAL, takes it
_MISSING = (
    "Surface models and orthophotos need GDAL (rasterio), which is not installed; install this program with it: "
    "pip install '.[geo]'."
)


@dataclass(frozen=True)
class Layer:
    """One of the files.

    Attributes
    ----------
    name : str
        Of the file.
    kind : str
        NumPy's name of its values' type.
    bands : tuple of str
        What each band is.
    nodata : float or None
    resampling : str
        How overviews are made.
    """

    name: str
    kind: str
    bands: tuple[str, ...]
    nodata: float | None
    resampling: str


def gdal() -> Any:
    """The module rasterio; `InputError` where it is not installed, or cannot be loaded."""
    try:
        return import_module("rasterio")
    except ModuleNotFoundError as error:
        raise InputError(_MISSING) from error
    except ImportError as error:
        raise InputError(f"GDAL cannot be loaded ({reason_of(error)}); install rasterio again.") from error


class LayerFiles:
    """Files that are filled tile by tile, and become cloud-optimised GeoTIFFs in the end.

    Parameters
    ----------
    scratch : Path
        Folder for them.
    layers : mapping of str to Layer
        By what `write` calls them.
    raster : Raster
    crs : str
        WKT; empty for none.
    tags : mapping of str to str
        Written into each file.
    """

    def __init__(
        self, scratch: Path, layers: Mapping[str, Layer], raster: Raster, crs: str, tags: Mapping[str, str]
    ) -> None:
        self._rasterio = gdal()
        self._scratch = scratch
        self._layers = layers
        self._raster = raster
        self._crs = crs
        self._tags = tags
        self._open: dict[str, Any] = {}
        self._stack = ExitStack()

    def __enter__(self) -> "LayerFiles":
        # What GDAL keeps counts as memory of ours; a file in parts would not be found again.
        self._stack.enter_context(self._rasterio.Env(GDAL_CACHEMAX=_CACHE, GDAL_PAM_ENABLED="NO"))
        for key, layer in self._layers.items():
            with self._in_words(layer):
                self._open[key] = self._stack.enter_context(self._create(layer))
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _create(self, layer: Layer) -> Any:
        raster = self._raster
        file = self._rasterio.open(
            self._part(layer),
            "w",
            driver="GTiff",
            width=raster.width,
            height=raster.height,
            count=len(layer.bands),
            dtype=layer.kind,
            crs=self._crs or None,
            transform=self._rasterio.Affine(raster.cell, 0, raster.left, 0, -raster.cell, raster.top),
            nodata=layer.nodata,
            tiled=True,
            blockxsize=_BLOCK,
            blockysize=_BLOCK,
            BIGTIFF="IF_SAFER",
            SPARSE_OK=True,
            **({"photometric": "RGB", "alpha": "yes"} if len(layer.bands) == 4 else {}),
        )
        file.descriptions = layer.bands
        file.update_tags(AREA_OR_POINT="Area", **self._tags)
        return file

    def _part(self, layer: Layer) -> Path:
        return self._scratch / f"part-{layer.name}"

    def write(self, key: str, tile: Tile, bands: list[NDArray[Any]]) -> None:
        """Write a tile of a layer, band by band."""
        window = self._rasterio.windows.Window(tile.column, tile.row, tile.width, tile.height)
        with self._in_words(self._layers[key]):
            for number, band in enumerate(bands, 1):
                self._open[key].write(np.ascontiguousarray(band), number, window=window)

    def finish(self) -> list[Path]:
        """Make the cloud-optimised files, in the scratch folder still."""
        copy = import_module("rasterio.shutil").copy
        done = []
        for key, layer in self._layers.items():
            path = self._scratch / layer.name
            with self._in_words(layer):
                self._open[key].close()
                copy(
                    self._part(layer),
                    path,
                    driver="COG",
                    COMPRESS="DEFLATE",
                    PREDICTOR="YES",
                    OVERVIEW_RESAMPLING=layer.resampling,
                    BIGTIFF="IF_SAFER",
                )
                self._part(layer).unlink()
                # A full disk does not always end a copy.
                with self._rasterio.open(path) as file:
                    file.read(1, window=self._rasterio.windows.Window(0, 0, 1, 1))
            done.append(path)
        return done

    @contextmanager
    def _in_words(self, layer: Layer) -> Iterator[None]:
        """GDAL's errors as ours, about the file that a layer becomes."""
        errors = self._rasterio.errors
        # Of copies, which rasterio lets through as they are: no error of its own, nor of the system.
        raw = import_module("rasterio._err").CPLE_BaseError
        try:
            yield
        except errors.CRSError as error:
            raise OptionError(f"crs is not known to GDAL ({reason_of(error)}); give another.", "crs") from error
        except (errors.RasterioError, raw, OSError) as error:
            cause = error.__cause__ or error
            raise OutputError(
                f"{self._scratch.parent / layer.name} cannot be written (GDAL: {reason_of(cause)}); check space "
                "and permissions, or choose another --output."
            ) from error
