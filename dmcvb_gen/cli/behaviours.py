"""train-behaviour, select-checkpoints, evaluate-behaviour."""

import dataclasses
import functools
import json
import shutil
import textwrap
from pathlib import Path
from typing import Any, Literal

import click

from dmcvb_gen.cli.common import INTERRUPTED, answer, json_option, print_json, print_table
from dmcvb_gen.cli.options import command_of
from dmcvb_gen.errors import PolicyFileError
from dmcvb_gen.generate.returns import evaluate_behaviour as evaluate
from dmcvb_gen.options import Local, Location
from dmcvb_gen.own_code import leave_of
from dmcvb_gen.progress import ProgressBar
from dmcvb_gen.spec import task_folder
from dmcvb_gen.text import quoted
from dmcvb_gen.training.behaviour import train_behaviour as train


@command_of(train)
@click.option(
    "--list-settings", is_flag=True, help="List what --set changes, with the task's values, and train nothing."
)
def train_behaviour(as_json, list_settings, **options):
    """Train a behaviour policy online on states.

    Ctrl-C saves the run, leaves a checkpoint that --behaviour RUN@latest takes, and prints the command that resumes
    it. A process that is killed loses ten minutes at most.

    \b
    dmcvb-gen train-behaviour walker-walk --out runs/walker-walk
    dmcvb-gen train-behaviour walker-walk --out runs/walker-walk --resume
    dmcvb-gen train-behaviour cheetah-run --algo sb3:TQC --list-settings
    dmcvb-gen train-behaviour cheetah-run --algo sb3:TQC --set gradient_steps=8
    dmcvb-gen train-behaviour ant-maze-medium7x7a --algo guided --out runs/ant
    dmcvb-gen train-behaviour ring.txt
    dmcvb-gen select-checkpoints runs/walker-walk
    """
    from dmcvb_gen.training.run import Stopped
    from dmcvb_gen.training.selection import selection_json

    if list_settings:
        return _list_settings(as_json, **options)
    try:
        run = train(notify=functools.partial(click.echo, err=True), **options)
    except Stopped as stopped:
        click.echo(str(stopped).replace("; ", "\n"), err=True)  # commands to copy, each on a line
        click.get_current_context().exit(INTERRUPTED)
    picked = run.selection
    if as_json:
        facts = dict(out=str(run.folder), steps=run.steps, seconds=round(run.seconds, 1), curve=str(run.curve))
        return print_json(facts | ({"selection": selection_json(picked)} if picked else {}))
    click.echo(f"Trained to {run.steps:,} agent steps: {run.curve}")
    if not picked:
        return click.echo(f"Next: {leave_of(options['task'])}dmcvb-gen select-checkpoints {quoted(run.folder)}")
    _show_picks(picked, run.folder)
    if "expert" in picked.picks:
        options = f"{quoted(options['task'] or picked.task)} --level expert --behaviour {quoted(run.folder)}"
        click.echo(f"Next: dmcvb-gen rollout {options}")


def _list_settings(as_json, *, task, algo, settings, **_):
    """Print every setting, its value for the task and what it means."""
    from dmcvb_gen.tasks import get_task, typed_task
    from dmcvb_gen.training.behaviour import own_maze
    from dmcvb_gen.training.settings import check_settings, default_run, describe_settings, parse_settings

    task = get_task(typed_task(task)).id
    algorithm = algo or ("guided" if own_maze(task) else "sac")
    given = parse_settings(settings, algorithm)
    values = dataclasses.asdict(check_settings(algorithm, default_run(task, algorithm)["settings"] | given))
    meanings = describe_settings(algorithm)
    if as_json:
        return print_json({name: {"value": values[name], "meaning": text} for name, text in meanings.items()})
    formatter = click.HelpFormatter(width=shutil.get_terminal_size().columns)
    formatter.write_dl([(f"{name}={json.dumps(values[name])}", text) for name, text in meanings.items()])
    click.echo(formatter.getvalue(), nl=False)


@click.command("select-checkpoints")
@click.argument("run", type=click.Path(path_type=Path))
@click.option(
    "--episodes", type=click.IntRange(2), default=100, show_default=True, help="Fresh episodes to score each pick."
)
@click.option(
    "--convergence",
    type=click.FloatRange(-1e9, 1e9),
    metavar="RETURN",
    help="Return at convergence of another run of the task.",
)
@json_option
def select_checkpoints(run, episodes, convergence, as_json):
    """Pick the expert, medium and mixed checkpoints of a run.

    Expert: the first with 95 % of the return at convergence; medium: half of it (mazes: nearest to the paper's row);
    mixed: eight, evenly spaced in training steps from the start to medium. Exit code 1 if none can be picked yet.

    \b
    dmcvb-gen select-checkpoints runs/walker-walk
    dmcvb-gen rollout walker-walk --level expert --behaviour runs/walker-walk
    """
    from dmcvb_gen.training.selection import select_checkpoints as select
    from dmcvb_gen.training.selection import selection_json

    with ProgressBar(not as_json, unit=" checkpoints", desc="selection") as bar:
        picked = select(run, episodes, bar, convergence)
    if as_json:
        print_json(selection_json(picked))
    else:
        _show_picks(picked, run)
    if not picked.picks:
        click.get_current_context().exit(1)


def _show_picks(picked, run):
    _tell(f"{task_folder(picked.task)}: return at convergence {picked.convergence.standing}")
    picks = [pick for level in picked.picks.values() for pick in level]
    if picks:
        found = [(pick, pick.evaluation) for pick in picks]
        rows = [(p.name, f"{p.step:,}", p.target, f"{fresh.mean:.1f}", f"{fresh.std:.1f}") for p, fresh in found]
        print_table(("pick", "agent step", "<aimed at", "mean", "std"), rows)
    for level, reason in picked.reasons.items():
        _tell(f"{level} cannot be picked yet: {reason}")
    click.echo(f"Wrote {'selected/, ' * bool(picks)}selection.json and curve.png into {run}.")


def _tell(sentence):
    """Print a sentence in lines that fit the terminal."""
    click.echo(textwrap.fill(sentence, shutil.get_terminal_size().columns, subsequent_indent="  "))


def _converted(
    source: Location,
    task: str,
    *,
    out: Local,
    level: Literal["expert", "medium", "mixed"] | None = None,
    activation: Literal["relu", "tanh", "elu", "gelu"] | None = None,
    actions: Literal["tanh", "clip"] | None = None,
    statistics: Location | None = None,
) -> Any:
    """Convert another program's policy; gives the header of the file.

    Args:
      source (SOURCE): The policy: a zip of Stable-Baselines3, or a torch state dict.
      task (TASK): Task that it acts in, or a maze's text file.
      out (FILE): Policy file to write (.safetensors).
      level: Level to note in the file.
      activation: Of hidden layers. [default: the program's]
      actions: Plain networks: how the output becomes an action in [-1, 1].
      statistics (FILE): .npz with "mean" and "std" of normalized observations, in the policy's own order, and "clip"
        if they were not clipped to 10.
    """
    from dmcvb_gen.policies.bundled import CONVERTED
    from dmcvb_gen.policies.convert import convert_file
    from dmcvb_gen.storage.places import local_path
    from dmcvb_gen.tasks import typed_task

    if Path(out).suffix in CONVERTED:
        raise PolicyFileError(f"--behaviour would take {out} for another program's file; end its name in .safetensors")
    distribution = actions and {"tanh": "deterministic", "clip": "gaussian"}[actions]
    options = dict(level=level, activation=activation, distribution=distribution, statistics=statistics)
    return convert_file(Path(source), typed_task(task), local_path(out), **options)


@command_of(_converted, "source", "task")
def convert_policy(as_json, progress, **options):
    """Convert another program's policy to a policy file: a Stable-Baselines3 zip or a torch state dict (CleanRL).

    Weights are read without unpickling anything. Data of a converted policy regenerate bit for bit. CleanRL's SAC keeps
    its mean alone; CleanRL's PPO and SB3's VecNormalize need --statistics. The zip of an off-policy algorithm does not
    say whether VecNormalize was used.

    \b
    dmcvb-gen convert-policy model.zip walker-run --out walker-run.safetensors
    dmcvb-gen convert-policy ppo.pt hopper-hop --statistics observations.npz \\
        --out hopper-hop.safetensors
    dmcvb-gen rollout walker-run --behaviour walker-run.safetensors
    """
    header = _converted(**options)
    layers = " x ".join(map(str, (header.observation_size, *header.hidden, header.action_size)))
    wrote = f"wrote {options['out']}: {layers}, {header.activation}, {header.distribution}"
    answer(as_json, header.model_dump(mode="json"), wrote)


@command_of(evaluate)
def evaluate_behaviour(as_json, progress, **options):
    """Measure the returns of behaviour policies over fresh episodes, beside the paper's.

    Without TASK: every bundled policy and random actions. With --behaviour: that policy or run.

    \b
    dmcvb-gen evaluate-behaviour
    dmcvb-gen evaluate-behaviour walker-walk --level expert --seed 1 --json
    dmcvb-gen evaluate-behaviour ant-maze-easy7x7a
    """
    rows = evaluate(**options)
    if as_json:
        return print_json(rows)
    _show_returns(rows, options["seed"])


def _show_returns(rows, seed):
    """Print returns, the paper's under each."""
    mazes = any("success" in row for row in rows)
    mode = next((row["mode"] for row in rows if row["level"] != "random"), "random")  # random actions have no mean
    statistics = ("mean", "std", "min", "p25", "median", "p75", "max")
    scores = ("success", "to goal m/s") if mazes else ()
    lines = []
    for row in rows:
        extra = [""] * len(scores)
        if "success" in row:
            extra = [f"{row['success']:.0%}", "-" if row["speed"] is None else f"{row['speed']:.2f}"]
        level = row["behaviour"] or row["level"]
        lines.append((task_folder(row["task"]), level, *(f"{row['returns'][key]:.1f}" for key in statistics), *extra))
        if row["paper"]:
            numbers = [f"{row['paper'][key]:.1f}" for key in statistics]
            lines.append(("  DMC-VB paper", row["level"], *numbers, *[""] * len(scores)))
    counts = " or ".join(map(str, sorted({row["episodes"] for row in rows})))
    print_table(
        ("task", "<level", *statistics, *scores),
        lines,
        title=f"{counts} episodes each, seed {seed}" + ("" if mode == "own" else f", {mode} actions"),
        optional=(("p25", "p75"), ("min", "max"), ("to goal m/s",)),
    )
