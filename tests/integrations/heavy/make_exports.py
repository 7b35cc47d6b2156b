"""Make small releases of a walker and a maze, export them, and keep the stored values beside, for the heavy tests.

python tests/integrations/heavy/make_exports.py FOLDER lerobot tfds zarr2
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(ROOT))

from dmcvb_gen.dataset.gate import Release  # noqa: E402
from dmcvb_gen.dataset.pictures import shown  # noqa: E402
from dmcvb_gen.generate.modalities import all_modalities  # noqa: E402
from dmcvb_gen.generate.repaint import Repainting, repaint  # noqa: E402
from dmcvb_gen.release.export import export  # noqa: E402
from tests.conftest import TINY_MAZE, roll_out, small_recipe  # noqa: E402

FORMATS = {"lerobot": ("lerobot",), "tfds": ("rlds",), "zarr2": ("replay-buffer",)}


def export_modalities(work: Path) -> None:
    """The walker with all modalities for LeRobot, and the images of the first episode as they must come back."""
    repaint(Repainting(work / "walker", work / "causes", labels=list(all_modalities())))
    [subset] = Release.open(work / "causes").subsets.values()
    values = subset.episode(0, list(all_modalities()))
    shown = {n: (one.gray if one.levels else one.color)(values[n]) for n, one in all_modalities().items()}
    np.savez(work / "causes.npz", **shown)
    [folder] = export(str(work / "causes"), "lerobot", work / "causes_out")
    folder.rename(work / "causes_export")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("formats", nargs="+", choices=list(FORMATS))
    given = parser.parse_args()
    work, chosen = given.folder, given.formats
    walker = {"tasks": "walker-walk", "levels": "random", "settings": ["static"], "episodes": 2}
    maze = {"tasks": TINY_MAZE, "levels": "random", "settings": ["visible", "hidden"], "episodes": 2}
    wanted = []
    for name, pattern in (("walker", walker), ("maze", maze)):
        folder = work / name
        roll_out(small_recipe(name=name, size=64, subsets=[pattern]), folder)
        for subset in Release.open(folder).subsets.values():
            pictures = shown(subset)
            flat = subset.name.replace("/", "_")
            arrays = {"views": np.array(pictures.views)}
            for index in range(2):
                values = subset.episode(index, ["state", "action", "reward", "terminated", *pictures.arrays])
                frames = np.stack([values.pop(name) for name in pictures.arrays], axis=1)
                arrays |= {f"pixels_{index}": frames} | {f"{n}_{index}": v for n, v in values.items()}
            np.savez(work / f"{flat}.npz", **arrays)
            folders = {"release": str(folder)}
            for what in chosen:
                for to in FORMATS[what]:
                    [folders[to]] = map(str, export(str(folder), to, work / to, [subset.name]))
            wanted.append({"subset": subset.name, "values": f"{flat}.npz", "hidden": pictures.hide_goal, **folders})
    if "lerobot" in chosen:
        export_modalities(work)
    (work / "wanted.json").write_text(json.dumps(wanted, indent=1))


if __name__ == "__main__":
    main()
