"""A finished workspace as one page to look at: map of the block, images, cloud, numbers of the run."""

from colmap_sph.pages.page import write_page as write_page
