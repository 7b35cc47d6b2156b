"""One small release of each family goes away without its images, and is painted in another style and size."""

import numpy as np
import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.pictures import shown
from tests.conftest import run, told

FAMILIES = {
    "locomotion": ("walker-walk", "--distractor", ("none", "dynamic")),
    "mazes": ("ant-maze-easy7x7b", "--goal", ("visible", "hidden", "fixed2")),
}


@pytest.fixture(scope="module", params=FAMILIES)
def made(request, tmp_path_factory):
    """Folder of a release of an expert's two short episodes a setting."""
    task, option, asked = FAMILIES[request.param]
    folder = tmp_path_factory.mktemp(request.param) / "r"
    short = ["--level", "expert", "--episodes", 2, "--max-steps", 6, "--size", 16]
    run("rollout", task, *[word for setting in asked for word in (option, setting)], *short, "--out", folder)
    return folder


@pytest.mark.slow_cases("mazes")
def test_it_travels_light_and_is_painted_on_arrival(made, tmp_path):
    run("publish", made, f"file://{tmp_path}/there", "--no-pixels")
    run("fetch", f"file://{tmp_path}/there", "--out", tmp_path / "here", "--paint")
    there, here = (Release.open(path) for path in (made, tmp_path / "here"))
    assert here.digest == there.digest and not any(subset.unpainted.any() for subset in here.subsets.values())


@pytest.mark.slow_cases("mazes")
def test_it_is_repainted_in_another_style_and_size(made, tmp_path):
    run("repaint", made, "--size", 24, "--split", "val", "--out", tmp_path / "val")
    assert told("verify", tmp_path / "val")["sound"]
    new, old = Release.open(tmp_path / "val"), Release.open(made)
    for name, subset in new.subsets.items():
        np.testing.assert_array_equal(subset.read("physics"), old[name].read("physics"))
        arrays = shown(subset).arrays
        means, before = ([one.read(a, [0]).mean((0, 1, 2, 3)) for a in arrays] for one in (subset, old[name]))
        moved = np.abs(np.subtract(means, before)).max()
        # Other videos and styles, by at least 13 grey levels; none has neither, another size alone moves it by one.
        assert (moved > 4) == (not name.endswith("/none")), name
