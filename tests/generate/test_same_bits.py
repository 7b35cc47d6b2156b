"""The same bits on every x86-64 processor: digests of short episodes, here and under emulated processors.

MuJoCo takes sines and the like from the system's mathematics library, and glibc has two sets of them: one for
processors with AVX2 and FMA, one for all others. So there are two families of processors: within each all bits are
equal, and `GLIBC_TUNABLES` makes a processor of the first give the bits of the second.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from dmcvb_gen.rendering import RENDERERS

TASKS = ("walker-walk", "cheetah-run", "humanoid-walk", "ant-maze-empty7x7")
STEPS = 3
PLAIN = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4"}
"""Makes glibc take the functions that every processor has."""
COMPILED = {
    "Haswell-v4": {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma"},
    "SandyBridge": {"NUMBA_CPU_NAME": "sandybridge", "NUMBA_CPU_FEATURES": "+avx"},
}
"""Processor model of qemu -> what makes numba compile for it. The first has no AVX-512, the second no AVX2. Compiled
here, as that takes minutes under emulation, and run there, from numba's cache."""
ALIKE = {"Haswell-v4": {}, "SandyBridge": PLAIN}
"""What else a process here needs to be like the model."""
OURS = {name: value for name, value in os.environ.items() if name != "OPENBLAS_CORETYPE"}
"""Without what makes BLAS take another processor's functions: a model would stop at what it does not have."""
PAINTER = "native" if "native" in RENDERERS else "-"

pytestmark = [
    pytest.mark.full,
    pytest.mark.skipif(not shutil.which("qemu-x86_64"), reason="no qemu-x86_64: apt-get install qemu-user"),
]


def start(model: str | None, environment: dict[str, str]) -> subprocess.Popen:
    command = [sys.executable, "-m", "tests.same_bits", str(STEPS), PAINTER, *TASKS]
    command = command if model is None else [shutil.which("qemu-x86_64"), "-cpu", model, *command]
    return subprocess.Popen(
        command,
        cwd=Path(__file__).parents[2],
        env=OURS | {"OMP_NUM_THREADS": "1"} | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.fixture(scope="module")
def found():
    """(where, model that it is compiled for or None) -> task -> name -> digest."""
    here = {("here", None): start(None, {})}
    here |= {("here", model): start(None, COMPILED[model] | ALIKE[model]) for model in COMPILED}
    printed = finish(here)
    return printed | finish({("there", model): start(model, COMPILED[model]) for model in COMPILED})


def finish(running):
    """The digests of processes that run side by side."""
    try:
        printed = {key: process.communicate() for key, process in running.items()}
    finally:
        for process in running.values():
            process.kill()
    for key, (out, err) in printed.items():
        assert running[key].returncode == 0 and out, f"{key}: {err[-2000:]}"
    return {key: json.loads(out) for key, (out, _) in printed.items()}


@pytest.mark.parametrize("task_id", TASKS)
@pytest.mark.parametrize("model", COMPILED)
def test_an_emulated_processor_gives_the_bits_of_this_one(found, model, task_id):
    assert found["there", model][task_id] == found["here", model][task_id]


@pytest.mark.parametrize("task_id", TASKS)
def test_code_for_this_processor_gives_the_bits_of_code_for_an_older_one(found, task_id):
    assert found["here", None][task_id] == found["here", "Haswell-v4"][task_id]


def test_actions_and_labels_of_equal_states_are_equal_in_both_families(found):
    compared = 0
    for task_id in TASKS:
        first, second = found["here", None][task_id], found["there", "SandyBridge"][task_id]
        if first["start"] == second["start"]:
            names = [name for name in first if name.startswith(("labels", "pictures", "action at", "start"))]
            assert {name: first[name] for name in names} == {name: second[name] for name in names}
            compared += len(names)
    assert compared
