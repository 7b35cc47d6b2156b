"""Makes the moving pictures of docs/gallery.md and README.md, with the package's own commands.

python scripts/make_gallery.py        (minutes on two cores; writes docs/gallery/*.webp and ant-maze.png)
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import yaml

from dmcvb_gen.dataset import open_release
from dmcvb_gen.loaders.register import MAZES, TASKS

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "docs/gallery"
STYLE_MAZE, STYLE_EPISODES = "ant-maze-medium7x7a", 24
"""Enough episodes to meet each of the four styles of data."""
FRAMES = 40
ONE = {"levels": "expert", "episodes": 1, "max_steps": FRAMES}
RECIPE = {
    "name": "gallery",
    "seed": 1,
    "subsets": [
        ONE | {"tasks": list(TASKS), "settings": ["none", "static", "dynamic"]},
        ONE | {"tasks": list(MAZES), "settings": ["visible", "hidden"], "max_steps": 90},
        {"tasks": list(MAZES), "levels": "expert", "settings": ["fixed"], "max_steps": 90}
        | {"fixed_goals": 1, "episodes_per_goal": 1},
    ],
}


def command(*arguments: object) -> None:
    subprocess.run([sys.executable, "-m", "dmcvb_gen", *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)


def moving(release: Path, only: str, name: str, *options: object) -> None:
    """`preview` of some subsets as docs/gallery/<name>.webp."""
    out = release / "preview" / name
    command("preview", release, "--only", only, "--video", "webp", "--frames", FRAMES, "--out", out, *options)
    shutil.copy(out / "preview.webp", PICTURES / f"{name}.webp")


def styles(work: Path) -> None:
    """An episode of every style of the mazes: four of data, one (of other videos and styles) of evaluation."""
    small = ["--level", "expert", "--max-steps", FRAMES, "--episodes", STYLE_EPISODES]
    command("rollout", STYLE_MAZE, *small, "--out", work / "train")
    command("repaint", work / "train", "--split", "val", "--out", work / "val")
    for split in ("train", "val"):
        [subset] = open_release(work / split).subsets.values()
        shown = subset.read("exogenous/style")[:, 0] // 100
        for style in sorted(set(shown.tolist())):
            first = int((shown == style).argmax())
            moving(work / split, subset.name, f"style-{style}", "--episode", first, "--scale", 1)


def main() -> None:
    PICTURES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        (work / "gallery.yaml").write_text(yaml.safe_dump(RECIPE))
        command("rollout", "--recipe", work / "gallery.yaml", "--out", work / "all")
        for task in TASKS:
            moving(work / "all", f"{task}/*/*", task)
        for task in MAZES:
            moving(work / "all", f"{task}/*/*", task, "--scale", 1)
        sheet = ["--only", "ant-maze-easy7x7a/*/visible", "--episodes", 1, "--out", work / "sheet"]
        command("preview", work / "all", *sheet)
        shutil.copy(work / "sheet/contact_sheet.png", ROOT / "docs/gallery/ant-maze.png")
        styles(work)


if __name__ == "__main__":
    main()
