"""Analytic scenes with exact depth and normals, stereo pairs for tests, and the demo block.

Each module imports only those before it: texture, primitives, terrain, rays, light, photographs' sky and optics,
render, pairs, ground, village, model, photographs, capture, block, street, canyon, town, wide.
"""

from colmap_sph.synthetic.block import BlockOptions, DemoBlock, demo_cameras, make_demo_block
from colmap_sph.synthetic.canyon import (
    CanyonOptions,
    build_canyon,
    canyon_cameras,
    canyon_gsd,
    make_canyon_block,
)
from colmap_sph.synthetic.capture import Capture, CaptureOptions, read_truth, write_capture
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
from colmap_sph.synthetic.photographs.bending import Bending
from colmap_sph.synthetic.photographs.imperfections import Imperfections
from colmap_sph.synthetic.photographs.photograph import exposure_gain, photograph
from colmap_sph.synthetic.photographs.real_camera import Motion, RealCamera, real_camera
from colmap_sph.synthetic.photographs.sky import Sky
from colmap_sph.synthetic.primitives import ConvexPolyhedron, Ellipsoid, Plane, Surface
from colmap_sph.synthetic.rays import Camera, Hits, trace_points
from colmap_sph.synthetic.render import Rendering, exact_geometry, render
from colmap_sph.synthetic.solids import box, gabled_house, sphere
from colmap_sph.synthetic.street import (
    BLANK_HOUSE,
    StreetOptions,
    build_street,
    make_street_block,
    street_cameras,
    street_gsd,
)
from colmap_sph.synthetic.terrain import Terrain
from colmap_sph.synthetic.texture import Facade, Material, Mottled, Noise, Painting, RoofTiles
from colmap_sph.synthetic.town import TownOptions, make_town_block, town_cameras
from colmap_sph.synthetic.village import Village, build_village

__all__ = [
    "BLANK_HOUSE",
    "Bending",
    "BlockOptions",
    "Camera",
    "CanyonOptions",
    "Capture",
    "CaptureOptions",
    "ConvexPolyhedron",
    "DemoBlock",
    "Ellipsoid",
    "Facade",
    "Hits",
    "Imperfections",
    "Light",
    "Material",
    "Motion",
    "Mottled",
    "Noise",
    "Painting",
    "Plane",
    "RealCamera",
    "Rendering",
    "RoofTiles",
    "ShadowMap",
    "Sky",
    "SparsePoints",
    "StreetOptions",
    "Surface",
    "SyntheticPair",
    "Terrain",
    "TownOptions",
    "Village",
    "box",
    "build_canyon",
    "build_reconstruction",
    "build_street",
    "build_village",
    "canyon_cameras",
    "canyon_gsd",
    "convergent_pair",
    "demo_cameras",
    "epipole_inside_pair",
    "exact_geometry",
    "exposure_gain",
    "forward_motion_pair",
    "gabled_house",
    "look_at",
    "make_canyon_block",
    "make_demo_block",
    "make_street_block",
    "make_town_block",
    "photograph",
    "pinhole",
    "read_truth",
    "real_camera",
    "render",
    "sample_sparse_points",
    "slanted_plane_pair",
    "sphere",
    "street_cameras",
    "street_gsd",
    "town_cameras",
    "trace_points",
    "visible",
    "write_capture",
    "write_reconstruction",
]
