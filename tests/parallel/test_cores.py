"""The cores that a batch system or a container grants are what commands use, not all of the machine's."""

import os

import pytest

from dmcvb_gen.parallel import cores, memory
from tests.conftest import python


@pytest.mark.parametrize("group", ["/", "/slurm/job_7/task_0"])
@pytest.mark.parametrize("limit, wanted", [("max 100000", 6), ("150000 100000", 2), ("50000 100000", 1), ("", 6)])
def test_the_fewer_of_affinity_and_container_count(tmp_path, monkeypatch, limit, wanted, group):
    monkeypatch.setattr(cores.os, "sched_getaffinity", lambda process: set(range(6)), raising=False)
    monkeypatch.setattr(memory, "CONTAINER", tmp_path)
    monkeypatch.setattr(memory, "GROUP", tmp_path / "cgroup")
    (tmp_path / "slurm/job_7/task_0").mkdir(parents=True)
    (tmp_path / "cgroup").write_text(f"4:memory:/\n0::{group}\n")
    (tmp_path / "slurm/cpu.max").write_text("max 100000\n")
    if limit:
        (tmp_path / group[1:].removesuffix("task_0") / "cpu.max").write_text(limit + "\n")
    assert cores.usable_cores() == wanted
    assert [cores.default_workers(most) for most in (0, 2, 100)] == [1, min(2, wanted), wanted]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system pins no processes")
def test_a_process_that_is_pinned_to_one_core_counts_one():
    code = "import os; os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])\n"
    code += "from dmcvb_gen.parallel.cores import usable_cores; print(usable_cores())"
    assert python(code).stdout == "1\n"
