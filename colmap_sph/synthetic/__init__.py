"""Analytic scenes with exact depth and normals, stereo pairs for tests, and the demo block.

Each module imports only those before it: texture, primitives, terrain, rays, light, render, pairs, ground,
village, model, block.
"""

from colmap_sph.synthetic.block import BlockOptions, DemoBlock, demo_cameras, make_demo_block, read_truth
from colmap_sph.synthetic.light import Light, ShadowMap
from colmap_sph.synthetic.model import (
    SparsePoints,
    build_reconstruction,
    sample_sparse_points,
    visible,
    write_reconstruction,
)
from colmap_sph.synthetic.pairs import (
    SyntheticPair,
    convergent_pair,
    epipole_inside_pair,
    forward_motion_pair,
    look_at,
    pinhole,
    slanted_plane_pair,
)
from colmap_sph.synthetic.primitives import ConvexPolyhedron, Ellipsoid, Plane, Surface
from colmap_sph.synthetic.rays import Camera, Hits, trace_points
from colmap_sph.synthetic.render import Rendering, exact_geometry, render
from colmap_sph.synthetic.solids import box, gabled_house, sphere
from colmap_sph.synthetic.terrain import Terrain
from colmap_sph.synthetic.texture import Facade, Material, Mottled, Noise, Painting, RoofTiles
from colmap_sph.synthetic.village import Village, build_village

__all__ = [
    "BlockOptions",
    "Camera",
    "ConvexPolyhedron",
    "DemoBlock",
    "Ellipsoid",
    "Facade",
    "Hits",
    "Light",
    "Material",
    "Mottled",
    "Noise",
    "Painting",
    "Plane",
    "Rendering",
    "RoofTiles",
    "ShadowMap",
    "SparsePoints",
    "Surface",
    "SyntheticPair",
    "Terrain",
    "Village",
    "box",
    "build_reconstruction",
    "build_village",
    "convergent_pair",
    "demo_cameras",
    "epipole_inside_pair",
    "exact_geometry",
    "forward_motion_pair",
    "gabled_house",
    "look_at",
    "make_demo_block",
    "pinhole",
    "read_truth",
    "render",
    "sample_sparse_points",
    "slanted_plane_pair",
    "sphere",
    "trace_points",
    "visible",
    "write_reconstruction",
]
