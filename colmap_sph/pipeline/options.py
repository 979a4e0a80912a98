"""Options of all stages in one record: what the command line, the Python API and the pipeline share."""

from dataclasses import dataclass, field, fields, is_dataclass

from colmap_sph.errors import OptionError
from colmap_sph.pipeline.memory import budget, parse_memory
from colmap_sph.platforms.control_groups import processors
from colmap_sph.platforms.processors import usable_cores
from colmap_sph.project.polishing import PolishOptions
from colmap_sph.project.region_file import AUTO, read_region
from colmap_sph.project.undistortion import UndistortionOptions
from colmap_sph.stereo.confirm import ConfirmOptions
from colmap_sph.stereo.fusion import FusionOptions
from colmap_sph.stereo.kernels import backend
from colmap_sph.stereo.matching import MatchingOptions
from colmap_sph.stereo.normals import NormalOptions
from colmap_sph.stereo.partners.pairs import PairOptions
from colmap_sph.stereo.rectification import RectificationOptions
from colmap_sph.stereo.refinement import RefinementOptions
from colmap_sph.stereo.vote import VoteOptions


def num_cores() -> int:
    """Cores that this process may use, which can be fewer than the machine has: their time may be limited, too."""
    cores = usable_cores()
    return min(cores, processors() or cores)


@dataclass(frozen=True)
class RunOptions:
    """Options of all stages and of the run itself."""

    threads: int = 0
    """Worker threads; 0: as many as the process may use cores."""
    memory: str = ""
    """Memory the run may use, such as "6GiB"; empty: a safe share of what is free."""
    scheduler: str = ""
    """Dask scheduler whose workers make the results, instead of this machine: its address, or the file in which it
    stands. Images and workspace must lie on a disk that all machines share."""
    region: str = ""
    """Part of the scene that is wanted, in the model's coordinates: a box x0,y0,z0,x1,y1,z1, a file of one as for
    COLMAP, or polygons in GeoJSON; or auto: what the images look at, without the background far behind. Images
    elsewhere are left out; maps and cloud end at its border."""
    undistortion: UndistortionOptions = field(default_factory=UndistortionOptions)
    pairs: PairOptions = field(default_factory=PairOptions)
    rectification: RectificationOptions = field(default_factory=RectificationOptions)
    matching: MatchingOptions = field(default_factory=MatchingOptions)
    polish: PolishOptions = field(default_factory=PolishOptions)
    vote: VoteOptions = field(default_factory=VoteOptions)
    confirm: ConfirmOptions = field(default_factory=ConfirmOptions)
    normals: NormalOptions = field(default_factory=NormalOptions)
    refinement: RefinementOptions = field(default_factory=RefinementOptions)
    fusion: FusionOptions = field(default_factory=FusionOptions)

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds, in any stage; it names an option as "pairs.num_pairs"."""
        if not 0 <= self.threads <= 1024:
            raise OptionError(f"threads must lie in 0..1024, not {self.threads}.", "threads")
        parse_memory(self.memory)
        if self.region and self.region != AUTO:
            read_region(self.region)
        if self.region and self.polish.is_wanted:
            raise OptionError(
                "--polish-poses moves all poses of a model, and --region looks at a part of it: polish in a run "
                "of its own, and give its dense workspace as --workspace together with --region."
            )
        for stage in (each.name for each in fields(self) if is_dataclass(getattr(self, each.name))):
            try:
                getattr(self, stage).check()
            except OptionError as error:
                raise error.spelled(f"{stage}.{{}}".format) from None
        folder = self.fusion.mask_path
        if folder is not None and not folder.is_dir():
            raise OptionError(f"fusion.mask_path: the folder {folder} does not exist.", "fusion.mask_path")
        backend()  # what COLMAP_SPH_KERNELS asks for must be there, too

    @property
    def num_threads(self) -> int:
        """Worker threads to use."""
        return self.threads or num_cores()

    @property
    def num_busy(self) -> int:
        """Of them, as many as there are cores for."""
        return min(self.num_threads, num_cores())

    @property
    def memory_budget(self) -> int:
        """Bytes of memory the run may use."""
        return budget(parse_memory(self.memory))
