"""Which precision trainings compute in: the faster one, measured on the products themselves."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import torch
from click.testing import CliRunner

from dmcvb_gen import precision
from dmcvb_gen.cli import main
from dmcvb_gen.training import sac
from dmcvb_gen.training.defaults import default_run
from dmcvb_gen.training.runs import read_config

SMALL = ("warmup_steps=8", "simulations=4", "batch_size=8", "compile=false")
SHORT = ["--steps=12", *(f"--set={pair}" for pair in SMALL)]


@pytest.mark.parametrize(("half", "chosen"), [(0.5, "bfloat16"), (0.99, "float32"), (8.0, "float32")])
def test_bfloat16_is_chosen_only_if_it_pays(monkeypatch, half, chosen):
    monkeypatch.setattr(precision, "fastest", lambda product, dtypes: {torch.float32: 1.0, torch.bfloat16: half})
    assert precision.choose_precision("auto", lambda dtype: None) == chosen
    for asked in ("float32", "bfloat16"):
        assert precision.choose_precision(asked, lambda dtype: None) == asked


def test_a_gpu_that_emulates_bfloat16_computes_in_float32(monkeypatch):
    def supported(including_emulation=True):
        return including_emulation

    monkeypatch.setattr(torch.cuda, "is_bf16_supported", supported)
    assert precision.choose_precision("auto", lambda dtype: None, "cuda") == "float32"


def test_the_probe_runs_the_product_in_both_precisions():
    seen = []
    seconds = precision.fastest(seen.append, (torch.float32, torch.bfloat16))
    assert set(seen) == set(seconds) == {torch.float32, torch.bfloat16} and all(s < 1 for s in seconds.values())


def test_the_probe_has_the_threads_of_the_training():
    seen, before = set(), torch.get_num_threads()
    precision.choose_precision("auto", lambda dtype: seen.add(torch.get_num_threads()), threads=before + 1)
    assert seen == {before + 1} and torch.get_num_threads() == before


def test_a_processor_without_bfloat16_computes_in_float32():
    code = (
        "from dmcvb_gen.agents.networks import PAPER, PATCHES, encoder_product\n"
        "from dmcvb_gen.precision import choose_precision, dense_product\n"
        "products = [dense_product(256, 256), encoder_product(PAPER), encoder_product(PATCHES)]\n"
        "print(*(choose_precision('auto', product) for product in products))"
    )
    only_avx2 = {"ONEDNN_MAX_CPU_ISA": "AVX2", "DNNL_MAX_CPU_ISA": "AVX2", "ATEN_CPU_CAPABILITY": "avx2"}
    run = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | only_avx2, capture_output=True, text=True, check=True
    )
    assert run.stdout.split() == ["float32"] * 4


@pytest.mark.parametrize("fast", ["float32", "bfloat16"])
def test_a_run_says_and_records_what_auto_chose(tmp_path, monkeypatch, fast):
    monkeypatch.setattr(sac, "choose_precision", lambda *arguments: fast)
    run = CliRunner().invoke(main, ["train-behaviour", "walker-walk", "--out", str(tmp_path / "run"), *SHORT])
    assert run.exit_code == 0, run.output
    assert f"Computing in {fast}" in run.stderr
    assert read_config(tmp_path / "run").settings["bfloat16"] == (fast == "bfloat16")


def test_settings_that_nothing_probed_compute_in_float32():
    """bench_training.py once took bfloat16 as a default: ten times slower without hardware for it."""
    assert not sac.SacSettings().bfloat16
    assert all("bfloat16" not in default_run(task)["settings"] for task in ("walker-walk", "ant-maze-empty7x7"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--algo", "tqc", "--precision", "float32"], "no effect with --algo tqc"),
        (["--precision", "float32", "--set", "bfloat16=true"], "not both"),
    ],
)
def test_a_precision_without_effect_is_refused(tmp_path, arguments, words):
    run = CliRunner().invoke(main, ["train-behaviour", "walker-walk", "--out", str(tmp_path / "run"), *arguments])
    assert run.exit_code == 2 and words in run.stderr
