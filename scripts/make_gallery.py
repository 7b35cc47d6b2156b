"""Make the moving pictures of README.md and docs/gallery.md with the package's own commands.

python scripts/make_gallery.py           (minutes on two cores; writes docs/gallery/*.webp and ant-maze.png)
python scripts/make_gallery.py --hero    (a minute; only the first picture of README.md, docs/gallery/hero.webp)
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import yaml
from PIL import Image, ImageDraw, ImageFont

import dmcvb_gen
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.generate.preview import video_bytes, video_frames
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


def moving(folder: Path, only: str, name: str, scale: int, episode: int | None = None) -> None:
    """An episode of some subsets side by side, as docs/gallery/<name>.webp."""
    release = Release.open(folder)
    subsets = [release[subset] for subset in release.select([only])]
    (PICTURES / f"{name}.webp").write_bytes(video_bytes(video_frames(subsets, scale, FRAMES, episode)))


def styles(work: Path) -> None:
    """An episode of every style of the mazes: four of data, one (of other videos and styles) of evaluation."""
    small = ["--level", "expert", "--max-steps", FRAMES, "--episodes", STYLE_EPISODES]
    command("rollout", STYLE_MAZE, *small, "--out", work / "train")
    command("repaint", work / "train", "--split", "val", "--out", work / "val")
    for split in ("train", "val"):
        [subset] = Release.open(work / split).subsets.values()
        shown = subset.read("exogenous/style")[:, 0] // 100
        for style in sorted(set(shown.tolist())):
            first = int((shown == style).argmax())
            moving(work / split, subset.name, f"style-{style}", 1, first)


# -- the hero: one instant of three tasks and a maze, under what varies in their pictures ---------

HERO_TASKS, HERO_MAZE, HERO_VIEW = ("walker-walk", "cheetah-run", "humanoid-walk"), "ant-maze-easy7x7a", "top"
HERO_STEPS, HERO_FRAMES, HERO_SEED = 84, 36, 5
"""Steps of an episode, of which the last are shown."""
LARGE, SMALL, GAP, BAR = 256, 64, 6, 30
"""Pixels a side of a large image and of what agents see; between images; of the line of names."""
PAPER, INK, QUIET = (255, 255, 255), (28, 35, 48), (102, 112, 133)


def hero(work: Path) -> None:
    """`docs/gallery/hero.webp`: columns are tasks, rows are distractors (styles for the maze), all at one instant."""
    common = ["--level", "expert", "--episodes", 1, "--max-steps", HERO_STEPS, "--seed", HERO_SEED, "--no-pixels"]
    for task in HERO_TASKS:
        settings = [word for name in ("none", "static", "dynamic") for word in ("--distractor", name)]
        command("rollout", task, *common, *settings, "--out", work / "hero" / task)
    command("rollout", HERO_MAZE, *common, "--goal", "visible", "--out", work / "hero" / HERO_MAZE)
    columns = [(task, _under_distractors(work / "hero" / task)) for task in HERO_TASKS]
    columns.append((HERO_MAZE, _in_styles(work / "hero" / HERO_MAZE)))
    frames = [_hero_frame(columns, frame) for frame in range(HERO_FRAMES)]
    path = PICTURES / "hero.webp"
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=50, loop=0, quality=62, method=6)


def _painted(folder: Path, name: str, array: str, size: int, epoch: int | None = None) -> list:
    """The last frames of an episode at a size, with the stored labels or the distractors of an epoch."""
    how = "stored" if epoch is None else "resample"
    subset = dmcvb_gen.open(str(folder), paint=True, size=size, distractors=how)[name]
    subset.set_epoch(epoch or 0)
    return list(subset.episode(0, [array])[array][-HERO_FRAMES:])


def _under_distractors(folder: Path) -> list[tuple[str, list, list]]:
    """(distractor, large frames, small frames) of the episode that the subsets share."""
    names = Release.open(folder).subsets
    return [
        (name.split("/")[-1], *(_painted(folder, name, "pixels", size) for size in (LARGE, SMALL))) for name in names
    ]


def _in_styles(folder: Path) -> list[tuple[str, list, list]]:
    """(style, large frames, small frames) of one episode in three styles of walls and floor."""
    [name] = Release.open(folder).subsets
    found: list[tuple[str, list, list]] = []
    for epoch in range(20):
        large, small = (_painted(folder, name, f"pixels/{HERO_VIEW}", size, epoch) for size in (LARGE, SMALL))
        color = small[0].mean((0, 1))  # styles differ in their colors
        if all(abs(color - other[0].mean((0, 1))).max() > 25 for _, _, other in found):
            found.append((f"look {len(found) + 1}", large, small))
        if len(found) == 3:
            break
    return found


def _hero_frame(columns: list[tuple[str, list[tuple[str, list, list]]]], frame: int) -> Image.Image:
    width, height = LARGE + SMALL + 2 * GAP, LARGE + GAP
    picture = Image.new("RGB", (len(columns) * width, BAR + 3 * height), PAPER)
    draw = ImageDraw.Draw(picture)
    for column, (task, cells) in enumerate(columns):
        left = column * width
        draw.text((left + 2, 5), task, fill=INK, font=ImageFont.load_default(17))
        for row, (name, large, small) in enumerate(cells):
            top = BAR + row * height
            picture.paste(Image.fromarray(large[frame]), (left, top))
            picture.paste(Image.fromarray(small[frame]), (left + LARGE + GAP, top + LARGE - SMALL))
            draw.text((left + LARGE + GAP, top + 2), name, fill=INK, font=ImageFont.load_default(15))
            draw.text(
                (left + LARGE + GAP, top + LARGE - SMALL - 17), "64 x 64", fill=QUIET, font=ImageFont.load_default(13)
            )
    return picture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hero", action="store_true", help="make only the first picture of README.md")
    given = parser.parse_args()
    PICTURES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        hero(work)
        if given.hero:
            return
        (work / "gallery.yaml").write_text(yaml.safe_dump(RECIPE))
        command("rollout", "--recipe", work / "gallery.yaml", "--out", work / "all")
        for task in (*TASKS, *MAZES):
            moving(work / "all", f"{task}/*/*", task, 2)
        sheet = ["--only", "ant-maze-easy7x7a/*/visible", "--episodes", 1, "--out", work / "sheet"]
        command("preview", work / "all", *sheet)
        shutil.copy(work / "sheet/contact_sheet.png", ROOT / "docs/gallery/ant-maze.png")
        styles(work)


if __name__ == "__main__":
    main()
