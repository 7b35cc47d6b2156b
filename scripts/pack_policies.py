"""Bundle what select-checkpoints picked from runs with the package, and write the table of docs/policies.md.

python scripts/pack_policies.py runs/cartpole-swingup runs/walker-run
python scripts/pack_policies.py                                        # the table alone
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

import numpy as np

from dmcvb_gen.policies.archives import bundled_digests, bundled_file, data_folder, pack
from dmcvb_gen.policies.bundled import bundled_levels, bundled_names, level_files
from dmcvb_gen.policies.paper import paper_returns
from dmcvb_gen.policies.policy_file import read_header
from dmcvb_gen.spec import MAZE_TRAINED_LEVELS, TRAINED_LEVELS, is_maze

PAGE = Path(__file__).parents[1] / "docs/policies.md"
TABLE = re.compile(r"(?<=<!-- scripts/pack_policies.py -->\n\n).*?(?=\n<!-- end -->)", re.DOTALL)
HEAD = "| task | level | return | the paper's | TD-MPC2, SAC | agent step | minutes |\n|---|---|---|---|---|---|---|\n"
OTHERS = {
    "ball_in_cup-catch": (986, 978),
    "cartpole-swingup": (876, 839),
    "cheetah-run": (844, 730),
    "finger-spin": (986, 878),
    "hopper-hop": (338, 70),
    "hopper-stand": (954, 302),
    "humanoid-walk": (628, 2),
    "quadruped-walk": (956, 455),
    "reacher-easy": (983, 914),
    "walker-run": (842, 635),
    "walker-stand": (991, 949),
    "walker-walk": (980, 957),
}
"""Returns of TD-MPC2 and SAC after a million frames, the mean of three seeds: results/ of
github.com/nicklashansen/tdmpc2 at commit e9f5932."""


def picked_of(run: Path) -> dict[str, bytes]:
    """ "<task>/<file>" -> bytes of a run's picks; ends the program if a level is missing."""
    files = {level: level_files(run / "selected", level) for level in TRAINED_LEVELS}
    [task] = {read_header(path).task for paths in files.values() for path in paths} or {""}
    for level in MAZE_TRAINED_LEVELS if is_maze(task) else TRAINED_LEVELS:
        if not files[level]:
            sys.exit(f"{run} has no {level}, so it is not shipped; dmcvb-gen select-checkpoints {run} says why")
    return {f"{task}/{path.name}": path.read_bytes() for paths in files.values() for path in paths}


def row(task: str, level: str) -> str:
    """The row of a level; the spread of mixed is that of the episodes of all eight."""
    headers = [read_header(bundled_file(name)) for name in bundled_names(task, level)]
    means = [header.evaluation.mean for header in headers]
    spread = np.sqrt(np.var(means) + np.mean([header.evaluation.std**2 for header in headers]))
    paper, others = paper_returns(task, level), OTHERS.get(task, ()) if level == "expert" else ()
    cells = [task, level, f"{np.mean(means):.0f} ± {spread:.0f}"]
    cells += [f"{paper['mean']:.0f} ± {paper['std']:.0f}" if paper else "", ", ".join(map(str, others))]
    cells += [f"{headers[-1].agent_step:,}", f"{headers[-1].training['seconds'] / 60:.1f}"]
    return "| " + " | ".join(cells) + " |\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="*")
    files: dict[str, bytes] = {}
    for run in parser.parse_args().runs:
        files |= picked_of(run)
    if files:
        pack(files, Path(str(data_folder())))
        bundled_digests.cache_clear()
    tasks = sorted({name.split("/")[0] for name in bundled_digests()})
    rows = [row(task, level) for task in tasks for level in bundled_levels(task)]
    PAGE.write_text(TABLE.sub(HEAD + "".join(rows), PAGE.read_text()))
    sizes = {path.name: path.stat().st_size for path in Path(str(data_folder())).glob("*.xz")}
    print(f"{sum(sizes.values()) / 1e6:.1f} MB: " + ", ".join(f"{name} {size:,}" for name, size in sizes.items()))


if __name__ == "__main__":
    main()
