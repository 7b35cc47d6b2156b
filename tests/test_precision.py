"""Which precision trainings compute in: what the processor has instructions for, never what a stopwatch says."""

from functools import partial

import pytest
import torch

from dmcvb_gen import precision
from dmcvb_gen.training.run import read_config
from tests.conftest import invoke

SHORT = "--steps=12 --set=warmup_steps=8 --set=simulations=4 --set=batch_size=8 --set=compile=false".split()


PROCESSORS = [
    ("fpu sse avx2 avx512f avx512_bf16", "bfloat16"),
    ("fpu avx512_bf16 amx_bf16 amx_tile", "bfloat16"),
    ("fpu avx2 avx512f avx512_vnni", "float32"),
    (None, "float32"),
]


@pytest.mark.parametrize("flags, chosen", PROCESSORS)
def test_the_processors_flags_decide(tmp_path, monkeypatch, flags, chosen):
    if flags:
        (tmp_path / "cpuinfo").write_text(f"processor\t: 0\nflags\t\t: {flags}\nbugs\t\t: amx_bf16_is_no_flag\n")
    monkeypatch.setattr(precision, "processor_flags", partial(precision.processor_flags, tmp_path / "cpuinfo"))
    assert precision.choose_precision("auto") == chosen
    for asked in ("float32", "bfloat16"):
        assert precision.choose_precision(asked) == asked


@pytest.mark.parametrize("native", [True, False])
def test_a_gpu_that_emulates_bfloat16_computes_in_float32(monkeypatch, native):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: including_emulation or native)
    assert precision.choose_precision("auto", "cuda") == ("bfloat16" if native else "float32")


@pytest.mark.slow
@pytest.mark.parametrize("fast", ["float32", "bfloat16"])
def test_a_run_says_and_records_what_auto_chose(tmp_path, monkeypatch, fast):
    monkeypatch.setattr(precision, "choose_precision", lambda *arguments: fast)
    run = invoke("train-behaviour", "walker-walk", "--out", tmp_path / "run", *SHORT, code=0)
    assert f", {fast}: " in run.stderr
    assert read_config(tmp_path / "run").settings["bfloat16"] == (fast == "bfloat16")
