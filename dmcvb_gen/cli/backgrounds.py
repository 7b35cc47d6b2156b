"""backgrounds."""

from __future__ import annotations

from pathlib import Path

import click

from dmcvb_gen.cli.common import OutPath, answer, json_option
from dmcvb_gen.progress import ProgressBar


@click.command()
@click.option("--videos", type=click.IntRange(1), default=8, show_default=True, help="Clips for each of train and val.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Random seed of the clips.")
@click.option(
    "--out",
    type=OutPath(path_type=Path),
    default=Path("data/backgrounds"),
    show_default=True,
    help="Folder of the clips.",
)
@click.option("--sheet", type=OutPath(path_type=Path), help="Also write a contact sheet of them, a PNG.")
@json_option
def backgrounds(videos, seed, out, sheet, as_json):
    """Make background clips: objects that fall and collide, 24 frames each (needs OpenGL).

    \b
    dmcvb-gen backgrounds --videos 60 --seed 1 --out data/backgrounds --sheet sheet.png
    dmcvb-gen rollout walker-walk --distractor dynamic --backgrounds data/backgrounds
    """
    if sheet and sheet.suffix.lower() != ".png":
        raise click.UsageError(f"--sheet {sheet} is no PNG: give a name that ends in .png")
    from PIL import Image

    from dmcvb_gen.distractors.clips import clip_sheet, make_clips

    with ProgressBar(not as_json, total=2 * videos, unit=" clips") as bar:
        made = make_clips(videos, seed, out, bar.update)
    if sheet:
        sheet.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(clip_sheet(out)).save(sheet)
    facts = {split: [str(path) for path in paths] for split, paths in made.items()}
    answer(as_json, facts, f"{out}: {videos} train and {videos} val clips; use them with --backgrounds {out}")
