"""Points of a cloud → what a page shows of it: few of them to turn, and pictures from above."""

from colmap_sph.pages.block_map import Frame, seen_from_above
from colmap_sph.pages.content import CloudDrawing, CloudSample
from colmap_sph.pages.pictures import layer_uri
from colmap_sph.pages.small_cloud import thin_out


def draw_cloud(cloud: CloudSample, frame: Frame) -> CloudDrawing | None:
    """Draw a cloud; None where it has no points.

    Parameters
    ----------
    cloud : CloudSample
    frame : Frame
        Of the map.

    Returns
    -------
    CloudDrawing or None
    """
    small = thin_out(cloud.points @ frame.axes.T, cloud.colours)
    if small is None:
        return None
    coloured, heights, ends = seen_from_above(frame, cloud.points, cloud.colours)
    return CloudDrawing(small, layer_uri(coloured), layer_uri(heights), ends)
