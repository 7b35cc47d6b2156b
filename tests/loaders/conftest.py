"""Small releases that several tests of readers share."""

import pytest

from tests.conftest import roll_out, small_recipe

FAMILIES = {"walker-walk": ["none", "dynamic"], "ant-maze-empty7x7": ["hidden", "visible"]}


@pytest.fixture(scope="session", params=FAMILIES)
def levels(request, tmp_path_factory):
    """(folder, names of two subsets) of a release with three random and two expert episodes a setting."""
    task, settings = request.param, FAMILIES[request.param]
    shape = {"tasks": task, "settings": settings, "episodes_per_shard": 2, "max_steps": 6}
    subsets = [shape | {"levels": level, "episodes": count} for level, count in (("random", 3), ("expert", 2))]
    folder = tmp_path_factory.mktemp(task) / "r"
    roll_out(small_recipe(name="levels", subsets=subsets), folder)
    return folder, [f"{task}/{level}/{settings[1]}" for level in ("random", "expert")]
