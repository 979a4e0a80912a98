"""Limits of control groups in made-up trees, as Docker, Kubernetes, Slurm and systemd set them up."""

import os
import resource
from pathlib import Path

import psutil
import pytest

from colmap_sph.pipeline import memory, options
from colmap_sph.platforms.control_groups import free_memory, processors

MIB = 1 << 20
GIB = 1 << 30
NONE_V1 = 9223372036854771712  # what version 1 writes where there is no limit


class Machine:
    """Files of a made-up system below a folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        (root / "proc/self").mkdir(parents=True)

    def groups(self, *lines: str) -> None:
        (self.root / "proc/self/cgroup").write_text("".join(f"{line}\n" for line in lines))

    def mounts(self, *mounts: str) -> None:
        """Each as "TOP POINT TYPE OPTIONS", among others."""
        lines = ["21 1 259:2 / / rw,relatime shared:1 - ext4 /dev/root rw,errors=remount-ro"]
        for number, mount in enumerate(mounts, start=31):
            top, point, kind, options = mount.split(" ")
            lines.append(f"{number} 21 0:{number} {top} {point} rw,nosuid shared:9 - {kind} cgroup rw,{options}")
        (self.root / "proc/self/mountinfo").write_text("".join(f"{line}\n" for line in lines))

    def folder(self, place: str, **files: object) -> None:
        """A group; `memory_max` stands for ``memory.max``."""
        folder = self.root / place
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            (folder / name.replace("_", ".", 1)).write_text(f"{content}\n")


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


V1_MOUNTS = ["/ /sys/fs/cgroup/cpu,cpuacct cgroup cpu,cpuacct", "/ /sys/fs/cgroup/memory cgroup memory"]
V2_MOUNT = "/ /sys/fs/cgroup cgroup2 nsdelegate"


def v1(limit: int, used: int, inactive: int = 0, above: int = NONE_V1) -> dict[str, object]:
    stat = (
        f"cache 1\nrss 2\ninactive_file 3\nhierarchical_memory_limit {above}\n"
        f"hierarchical_memsw_limit {NONE_V1}\ntotal_inactive_file {inactive}"
    )
    return {"memory_limit_in_bytes": limit, "memory_usage_in_bytes": used, "memory_stat": stat}


def v2(limit: object, used: int, inactive: int = 0, high: object = "max") -> dict[str, object]:
    return {
        "memory_max": limit,
        "memory_high": high,
        "memory_current": used,
        "memory_stat": f"anon 5\nfile 6\ninactive_file {inactive}\nslab 7",
        "memory_swap.max": 0,
    }


# ---- the systems people run in -----------------------------------------------------------------------------


def test_docker_v1(machine: Machine) -> None:
    """The container is told the host's path, and sees its own group at the top of the mount."""
    path = "/docker/0123abc"
    machine.groups(f"12:cpu,cpuacct:{path}", f"9:memory:{path}", f"1:name=systemd:{path}", "0::/system.slice")
    machine.mounts(
        f"{path} /sys/fs/cgroup/cpu,cpuacct cgroup cpu,cpuacct", f"{path} /sys/fs/cgroup/memory cgroup memory"
    )
    machine.folder("sys/fs/cgroup/memory", **v1(GIB, 400 * MIB, inactive=100 * MIB, above=GIB))
    machine.folder("sys/fs/cgroup/cpu,cpuacct", cpu_cfs_quota_us=150000, cpu_cfs_period_us=100000)
    assert free_memory(machine.root) == 724 * MIB
    assert processors(machine.root) == 2


@pytest.mark.parametrize("path", ["/", "/../../system.slice/docker-0123.scope", "/docker/not/here"])
def test_docker_v2(path: str, machine: Machine) -> None:
    """A namespace has its group at the top, whatever path the process is told."""
    machine.groups(f"0::{path}")
    machine.mounts(V2_MOUNT)
    machine.folder("sys/fs/cgroup", **v2(2 * GIB, GIB, inactive=256 * MIB), cpu_max="50000 100000")
    assert free_memory(machine.root) == 2 * GIB - 768 * MIB
    assert processors(machine.root) == 1


def test_docker_v1_with_a_namespace(machine: Machine) -> None:
    machine.groups("4:memory:/", "2:cpu:/")
    machine.mounts("/ /sys/fs/cgroup/memory cgroup memory", "/ /sys/fs/cgroup/cpu cgroup cpu")
    machine.folder("sys/fs/cgroup/memory", **v1(GIB, 0))
    machine.folder("sys/fs/cgroup/cpu", cpu_cfs_quota_us=-1, cpu_cfs_period_us=100000)
    assert free_memory(machine.root) == GIB
    assert processors(machine.root) is None


def test_kubernetes_v2(machine: Machine) -> None:
    """With the host's namespace; the pod's limit is below the container's."""
    pod = "kubepods.slice/kubepods-burstable.slice/kubepods-burstable-pod12_ab.slice"
    machine.groups(f"0::/{pod}/cri-containerd-9f.scope")
    machine.mounts(V2_MOUNT)
    machine.folder("sys/fs/cgroup", cgroup_controllers="cpu memory")
    machine.folder("sys/fs/cgroup/kubepods.slice", **v2(60 * GIB, 20 * GIB), cpu_max="max 100000")
    machine.folder(f"sys/fs/cgroup/{pod}", **v2(3 * GIB, GIB), cpu_max="350000 100000")
    machine.folder(f"sys/fs/cgroup/{pod}/cri-containerd-9f.scope", **v2("max", GIB), cpu_max="600000 100000")
    assert free_memory(machine.root) == 2 * GIB
    assert processors(machine.root) == 4


def test_slurm_v2(machine: Machine) -> None:
    """The job's limit is three levels above the process."""
    place = "sys/fs/cgroup/system.slice/slurmstepd.scope/job_1"
    machine.groups("0::/system.slice/slurmstepd.scope/job_1/step_0/user/task_0")
    machine.mounts(V2_MOUNT)
    machine.folder(place, **v2(8 * GIB, 3 * GIB, inactive=GIB), cpu_max="max 100000")
    machine.folder(f"{place}/step_0", **v2("max", 3 * GIB))
    machine.folder(f"{place}/step_0/user", **v2("max", 3 * GIB))
    machine.folder(f"{place}/step_0/user/task_0", **v2("max", 2 * GIB))
    assert free_memory(machine.root) == 6 * GIB
    assert processors(machine.root) is None


def test_slurm_v1(machine: Machine) -> None:
    path = "/slurm/uid_1000/job_1/step_0/task_0"
    machine.groups(f"9:memory:{path}", f"3:cpu,cpuacct:{path}", "5:freezer:/slurm/uid_1000/job_1/step_0")
    machine.mounts(*V1_MOUNTS)
    place = "sys/fs/cgroup/memory/slurm/uid_1000"
    machine.folder("sys/fs/cgroup/memory", **v1(NONE_V1, 50 * GIB))
    machine.folder(place, **v1(NONE_V1, 9 * GIB))
    machine.folder(f"{place}/job_1", **v1(8 * GIB, 5 * GIB, above=8 * GIB))
    machine.folder(f"{place}/job_1/step_0", **v1(8 * GIB, 4 * GIB, above=8 * GIB))
    machine.folder(f"{place}/job_1/step_0/task_0", **v1(NONE_V1, 4 * GIB, above=8 * GIB))
    assert free_memory(machine.root) == 3 * GIB


def test_limits_above_what_a_container_sees(machine: Machine) -> None:
    """Version 1 tells the least limit of all ancestors."""
    machine.groups("4:memory:/kubepods/pod1/c1")
    machine.mounts("/kubepods/pod1/c1 /sys/fs/cgroup/memory cgroup memory")
    machine.folder("sys/fs/cgroup/memory", **v1(NONE_V1, GIB, above=3 * GIB))
    assert free_memory(machine.root) == 2 * GIB


def test_systemd_user_slice(machine: Machine) -> None:
    """`MemoryHigh` throttles before `MemoryMax` kills."""
    place = "sys/fs/cgroup/user.slice/user-1000.slice"
    machine.groups("0::/user.slice/user-1000.slice/user@1000.service/app.slice/run-r1.scope")
    machine.mounts(V2_MOUNT)
    machine.folder(place, **v2(16 * GIB, 6 * GIB, high=10 * GIB))
    machine.folder(f"{place}/user@1000.service", **v2("max", 6 * GIB), cpu_max="20000 100000")
    assert free_memory(machine.root) == 4 * GIB
    assert processors(machine.root) == 1


def test_hybrid(machine: Machine) -> None:
    """Version 2 is there, but without controllers: memory and processors are in version 1."""
    machine.groups("8:memory:/job", "6:cpuacct:/other", "5:cpu:/job", "0::/user.slice")
    machine.mounts(
        "/ /sys/fs/cgroup/unified cgroup2 nsdelegate",
        "/ /sys/fs/cgroup/memory cgroup memory",
        "/ /sys/fs/cgroup/cpuacct cgroup cpuacct",
        "/ /sys/fs/cgroup/cpu cgroup cpu",
    )
    machine.folder("sys/fs/cgroup/unified/user.slice", cgroup_procs="1")
    machine.folder("sys/fs/cgroup/memory/job", **v1(5 * GIB, GIB))
    machine.folder("sys/fs/cgroup/cpu/job", cpu_cfs_quota_us=300000, cpu_cfs_period_us=100000)
    machine.folder("sys/fs/cgroup/cpuacct/other", cpu_cfs_quota_us=100000, cpu_cfs_period_us=100000)
    assert free_memory(machine.root) == 4 * GIB
    assert processors(machine.root) == 3


# ---- odd and broken systems --------------------------------------------------------------------------------


def test_more_in_use_than_allowed_leaves_nothing(machine: Machine) -> None:
    machine.groups("0::/a")
    machine.mounts(V2_MOUNT)
    machine.folder("sys/fs/cgroup/a", **v2(GIB, 3 * GIB))
    assert free_memory(machine.root) == 0


def test_odd_paths(machine: Machine) -> None:
    """Colons and blanks in names, a mount elsewhere, and one of another container that does not count."""
    machine.groups("0::/a:b c")
    machine.mounts("/other /mnt/other cgroup2 x", "/ /run/my\\040groups cgroup2 x")
    machine.folder("mnt/other", **v2(MIB, 0))
    machine.folder("run/my groups/a:b c", **v2(GIB, 0))
    assert free_memory(machine.root) == GIB


def test_without_control_groups(machine: Machine) -> None:
    assert (free_memory(machine.root), processors(machine.root)) == (None, None)
    machine.groups("0::/")
    assert (free_memory(machine.root), processors(machine.root)) == (None, None)
    machine.mounts(V2_MOUNT)
    assert (free_memory(machine.root), processors(machine.root)) == (None, None)


def test_files_that_cannot_be_read(machine: Machine) -> None:
    """A folder where a file belongs cannot be read by anybody, root among them."""
    machine.groups("0::/a/b")
    machine.mounts(V2_MOUNT)
    for name in ("memory.max", "cpu.max", "memory.current"):
        (machine.root / "sys/fs/cgroup/a/b" / name).mkdir(parents=True)
    machine.folder("sys/fs/cgroup/a", memory_max=GIB, cpu_max="200000 100000")
    assert free_memory(machine.root) == GIB
    assert processors(machine.root) == 2


@pytest.mark.parametrize("garbage", ["", "\x00\xff", "-5", "1e9", "max max max", "9" * 5000, "0 0", "٣"])
def test_garbage_limits_nothing(garbage: str, machine: Machine) -> None:
    machine.groups("0::/a", "4:memory:/a", "5:cpu:/a")
    machine.mounts(V2_MOUNT, *V1_MOUNTS)
    names = ["memory_max", "memory_high", "memory_current", "memory_stat", "cpu_max"]
    machine.folder("sys/fs/cgroup/a", **dict.fromkeys(names, garbage))
    names = ["memory_limit_in_bytes", "memory_usage_in_bytes", "memory_stat"]
    machine.folder("sys/fs/cgroup/memory/a", **dict.fromkeys(names, garbage))
    machine.folder("sys/fs/cgroup/cpu,cpuacct/a", cpu_cfs_quota_us=garbage, cpu_cfs_period_us=garbage)
    assert processors(machine.root) is None
    assert free_memory(machine.root) in ((0,) if garbage == "0 0" else (None,))


@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00", b"0:\n::\n0::\n", b"a b - c\n - cgroup2\n", b"0::a\n"])
def test_garbage_in_place_of_groups_and_mounts(content: bytes, machine: Machine) -> None:
    (machine.root / "proc/self/cgroup").write_bytes(content)
    (machine.root / "proc/self/mountinfo").write_bytes(content)
    assert (free_memory(machine.root), processors(machine.root)) == (None, None)


# ---- what a run makes of it --------------------------------------------------------------------------------


def test_the_budget_keeps_to_the_group(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("colmap_sph.platforms.control_groups.free_memory", lambda: 100 * MIB)
    used = memory.resident()
    assert memory.budget(0) - used == pytest.approx(70 * MIB, abs=20 * MIB)


def test_threads_keep_to_the_quota(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(options, "processors", lambda: 1)
    assert options.RunOptions().num_threads == 1
    monkeypatch.setattr(options, "processors", lambda: 10_000)
    assert options.RunOptions().num_threads == len(os.sched_getaffinity(0))
    assert options.RunOptions(threads=7).num_threads == 7


@pytest.mark.parametrize(("kind", "field"), [(resource.RLIMIT_AS, "vms"), (resource.RLIMIT_DATA, "data")])
def test_the_budget_keeps_to_ulimit(kind: int, field: str) -> None:
    before = resource.getrlimit(kind)
    resource.setrlimit(kind, (getattr(psutil.Process().memory_info(), field) + 200 * MIB, before[1]))
    try:
        assert memory.budget(0) - memory.resident() == pytest.approx(140 * MIB, abs=30 * MIB)
    finally:
        resource.setrlimit(kind, before)
