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
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

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

pytestmark = [
    pytest.mark.full,
    pytest.mark.skipif(not shutil.which("qemu-x86_64"), reason="no qemu-x86_64: apt-get install qemu-user"),
]


def digests(model: str | None, environment: dict[str, str]) -> dict:
    """Task -> name -> digest, as a process prints them, under an emulated processor if a model is named."""
    command = [sys.executable, "-m", "tests.same_bits", str(STEPS), *TASKS]
    command = command if model is None else [shutil.which("qemu-x86_64"), "-cpu", model, *command]
    variables = OURS | {"OMP_NUM_THREADS": "1"} | environment
    done = subprocess.run(command, cwd=Path(__file__).parents[2], env=variables, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout, f"{command}, {environment}: {done.stderr[-2000:]}"
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def found():
    """(where, model that it is compiled for or None) -> what `digests` gives; processes of a place run side by side."""
    here = {("here", None): (None, {})}
    here |= {("here", model): (None, COMPILED[model] | ALIKE[model]) for model in COMPILED}
    there = {("there", model): (model, COMPILED[model]) for model in COMPILED}
    printed = {}
    for place in (here, there):
        with ThreadPoolExecutor(len(place)) as pool:
            printed |= zip(place, pool.map(digests, *zip(*place.values(), strict=True)), strict=True)
    return printed


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
