"""The whole cloud of a workspace for a browser on this machine: as many of its points as the view can show."""

from colmap_sph.pages.whole_cloud.server import CloudServer as CloudServer
