"""train-behaviour, select-checkpoints, evaluate-behaviour."""

from __future__ import annotations

from pathlib import Path

import click

from dmcvb_gen.cli.common import OutPath, json_option, print_json, print_table
from dmcvb_gen.progress import ProgressBar


@click.command("train-behaviour")
@click.argument("task", required=False)
@click.option(
    "--layout",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Text file of a maze of your own, instead of TASK: learns to walk it (guided) and selects checkpoints.",
)
@click.option("--out", type=OutPath(path_type=Path), help="Folder of the run.  [default: runs/TASK]")
@click.option("--steps", type=click.IntRange(1), help="Agent steps (at action repeat 2).  [default: the task's]")
@click.option("--seed", type=click.IntRange(0), help="Random seed.  [default: 0]")
@click.option(
    "--algo", help="sac, mpo, guided (mazes), or SB3's sb3-sac, td3, tqc, ppo.  [default: sac; --layout: guided]"
)
@click.option("--set", "pairs", multiple=True, metavar="KEY=VALUE", help="Override a setting. Repeatable.")
@click.option("--config", type=click.Path(path_type=Path), help="A YAML file of settings.")
@click.option("--init-from", metavar="RUN|FILE", help="Run or policy file to start from; guided: the guide.")
@click.option("--evaluate-every", type=click.IntRange(1), help="Agent steps between evaluations while returns are low.")
@click.option(
    "--precision",
    type=click.Choice(["auto", "float32", "bfloat16"]),
    default="auto",
    show_default=True,
    help="sac: precision of hidden layers; auto times both.",
)
@click.option("--resume", is_flag=True, help="Resume the run in --out with its own settings.")
@json_option
@click.pass_context
def train_behaviour(
    context, task, layout, out, steps, seed, algo, pairs, config, init_from, evaluate_every, precision, resume, as_json
):
    """Train a behaviour policy online on states.

    Ctrl-C saves the run and prints the command that resumes it; a process that is killed loses less than a minute.

    \b
    dmcvb-gen train-behaviour walker-walk --out runs/walker-walk
    dmcvb-gen train-behaviour walker-walk --out runs/walker-walk --resume
    dmcvb-gen train-behaviour cheetah-run --algo tqc --set gradient_steps=8 --out runs/cheetah-tqc
    dmcvb-gen train-behaviour ant-maze-medium7x7a --algo guided --out runs/ant-maze-medium7x7a
    dmcvb-gen train-behaviour --layout ring.txt --out runs/ring
    dmcvb-gen select-checkpoints runs/walker-walk
    """
    import torch

    from dmcvb_gen.errors import DmcvbError
    from dmcvb_gen.own_code import allow
    from dmcvb_gen.policies.paper import paper_returns
    from dmcvb_gen.spec import MazeName, task_folder
    from dmcvb_gen.tasks import get_task
    from dmcvb_gen.tasks.ant_maze import layout_task_id
    from dmcvb_gen.training.defaults import parse_settings, run_config
    from dmcvb_gen.training.runs import Stopped, read_config
    from dmcvb_gen.training.selection import plot_curve, selection_json
    from dmcvb_gen.training.training import open_run

    if (task is None) == (layout is None):
        raise click.UsageError("Give a TASK, or the file of a maze with --layout.")
    task = task or layout_task_id(layout)
    allow([task])  # a person typed its name, so its code may run
    get_task(task)
    folder = out or Path("runs") / (MazeName.parse(task).layout if layout else task)
    found = read_config(folder) if resume else None
    if resume and found is None:
        raise DmcvbError(f"{folder} holds no run to resume; give its folder with --out, or remove --resume")
    algorithm = algo or (found.algorithm if found else "guided" if layout else "sac")
    given = dict(steps=steps, seed=seed, evaluate_every=evaluate_every, init_from=init_from)
    settings = parse_settings(pairs, config, algorithm)
    chosen = _precision(precision, algorithm, settings, found)
    configuration = run_config(task, algorithm, settings | chosen, found, **given)
    run = open_run(folder, configuration, resume)
    if chosen and precision == "auto":
        name = "bfloat16" if chosen["bfloat16"] else "float32"
        click.echo(f"Computing in {name}, the faster one on this processor.", err=True)
    torch.set_num_threads(1)  # more gain nothing at these sizes, and one gives the same bits on every machine
    saved = run.saved()
    if resume and not saved:
        click.echo(f"Nothing is saved in {folder} yet, so the run begins at step 0.", err=True)
    done = saved["step"] if saved else 0
    expert = paper_returns(task, "expert")
    with ProgressBar(
        not as_json, total=configuration.steps, initial=done, unit=" steps", unit_scale=True, desc=task_folder(task)
    ) as bar:

        def report(progress):
            bar.set_postfix_str(_standing(progress, expert), refresh=False)

        try:
            run.train(report, bar.update, lambda: click.echo("\nStopping: the run is being saved.", err=True))
        except Stopped as stopped:
            bar.close()
            click.echo(stopped, err=True)
            context.exit(1)
    curve, selecting = plot_curve(folder, expert and expert["mean"]), f"dmcvb-gen select-checkpoints {folder}"
    try:
        picked = _select(folder, as_json) if layout else None
    except KeyboardInterrupt:
        click.echo(f"Interrupted. The run is trained; select its checkpoints: {selecting}", err=True)
        context.exit(1)
    if as_json:
        facts = dict(out=str(folder), steps=run.step, seconds=round(run.seconds, 1), curve=str(curve))
        return print_json(facts | ({"selection": selection_json(picked)} if picked else {}))
    click.echo(f"{folder}: trained to {run.step:,} agent steps; its curve is {curve}.")
    if not picked:
        return click.echo(f"Next: {selecting}")
    _show_picks(picked, folder)
    if "expert" in picked.picks:
        click.echo(f"Next: dmcvb-gen rollout --layout {layout} --level expert --behaviour {folder} --goal visible")


def _select(folder, as_json, episodes=100, seed=20_000, sample=False, converged=None):
    from dmcvb_gen.training.selection import select_checkpoints

    with ProgressBar(not as_json, unit=" checkpoints", desc="selection") as bar:
        return select_checkpoints(folder, episodes, seed, not sample, converged, bar)


def _standing(progress, expert):
    """The last evaluation beside the paper's expert, and the pace."""
    mean, pace = progress.evaluation.mean, f"{progress.updates_per_second:.0f} updates/s"
    if not expert:
        return f"return {mean:.1f}, {pace}"
    share = f" ({100 * mean / expert['mean']:.0f} %)" if expert["mean"] > 0 else ""  # mazes' returns are costs
    return f"return {mean:.1f} of the paper's {expert['mean']:.0f}{share}, {pace}"


def _precision(asked, algorithm, settings, found):
    """The setting that --precision decides; none if a run is resumed or has one of its own."""
    from dmcvb_gen.precision import choose_precision, dense_product
    from dmcvb_gen.training.sac import SacSettings

    if algorithm != "sac":
        if asked != "auto":
            raise click.UsageError(f"--precision has no effect with --algo {algorithm}: remove it.")
        return {}
    if asked == "auto" and (found or "bfloat16" in settings):
        return {}
    if "bfloat16" in settings:
        raise click.UsageError("Give --precision or --set bfloat16, not both.")
    sizes = SacSettings(**settings)
    precision = choose_precision(asked, dense_product(sizes.critic_hidden[-1], sizes.batch_size))
    return {"bfloat16": precision == "bfloat16"}


@click.command("select-checkpoints")
@click.argument("run", type=click.Path(path_type=Path))
@click.option(
    "--episodes", type=click.IntRange(2), default=100, show_default=True, help="Fresh episodes to score each pick."
)
@click.option("--seed", type=click.IntRange(0), default=20_000, show_default=True)
@click.option("--sample", is_flag=True, help="Score sampled actions instead of the policy mean.")
@click.option("--converged", type=float, help="Return at convergence, of a longer run.  [default: from the curve]")
@json_option
def select_checkpoints(run, episodes, seed, sample, converged, as_json):
    """Pick the expert, medium and mixed checkpoints of a run.

    Expert: the first with 95 % of the return at convergence; medium: half of it (mazes: nearest to the paper's row);
    mixed: eight, evenly spaced in training steps from the start to medium.

    \b
    dmcvb-gen select-checkpoints runs/walker-walk
    dmcvb-gen rollout walker-walk --level expert --behaviour runs/walker-walk --episodes 20
    """
    from dmcvb_gen.training.selection import selection_json

    picked = _select(run, as_json, episodes, seed, sample, converged)
    if as_json:
        return print_json(selection_json(picked))
    _show_picks(picked, run)


def _show_picks(picked, run):
    from dmcvb_gen.spec import task_folder

    end = picked.convergence
    state = "converged" if end.converged else f"not converged ({end.reason})"
    click.echo(f"{task_folder(picked.task)}: return at convergence {end.value:.1f} +- {end.error:.1f}, {state}")
    picks = [pick for level in picked.picks.values() for pick in level]
    if picks:
        print_table(
            ("pick", "agent step", "<aimed at", "mean", "std"),
            [
                (pick.name, f"{pick.step:,}", pick.target, f"{pick.evaluation.mean:.1f}", f"{pick.evaluation.std:.1f}")
                for pick in picks
            ],
        )
    for level, reason in picked.reasons.items():
        click.echo(f"{level} cannot be picked yet: {reason}")
    click.echo(f"wrote {run}/selected, {run}/selection.json, {run}/curve.png")


@click.command("convert-policy")
@click.argument("source", type=click.Path(path_type=Path))
@click.argument("task")
@click.option("--out", type=OutPath(path_type=Path), required=True, help="Policy file to write (.safetensors).")
@click.option("--level", type=click.Choice(["expert", "medium", "mixed"]), help="Level to note in the file.")
@click.option("--hidden", metavar="N,N,...", help="Widths that the hidden layers must have.  [default: as they are]")
@click.option(
    "--activation",
    type=click.Choice(["relu", "tanh", "elu", "gelu"]),
    help="Of hidden layers.  [default: the program's]",
)
@click.option(
    "--actions",
    "distribution",
    type=click.Choice(["tanh", "clip"]),
    help="Plain networks: how the output becomes an action in [-1, 1].",
)
@click.option(
    "--statistics", type=click.Path(path_type=Path), help='.npz with "mean" and "std" of normalized observations.'
)
@json_option
def convert_policy(source, task, out, level, hidden, activation, distribution, statistics, as_json):
    """Convert another program's policy to a policy file: a Stable-Baselines3 zip or a torch state dict (CleanRL).

    Weights are read without unpickling anything. Data of a converted policy regenerate bit for bit. CleanRL's SAC keeps
    its mean alone, and SB3's VecNormalize needs --statistics.

    \b
    dmcvb-gen convert-policy model.zip walker-run --out walker-run.safetensors
    dmcvb-gen convert-policy ppo.pt hopper-hop --hidden 64,64 --statistics observations.npz --out hopper-hop.safetensors
    dmcvb-gen rollout walker-run --level expert --behaviour walker-run.safetensors --episodes 20
    """
    from dmcvb_gen.own_code import allow
    from dmcvb_gen.policies.convert import convert_file

    allow([task])  # a person typed its name, so its code may run
    try:
        widths = [int(width) for width in hidden.split(",")] if hidden else None
    except ValueError:
        raise click.UsageError(f"--hidden {hidden!r} is no list of widths such as 256,256.") from None
    header = convert_file(
        source,
        task,
        out,
        level=level,
        hidden=widths,
        activation=activation,
        distribution=distribution and {"tanh": "deterministic", "clip": "gaussian"}[distribution],
        statistics=statistics,
    )
    if as_json:
        return print_json(header.model_dump(mode="json"))
    layers = " x ".join(map(str, (header.observation_size, *header.hidden, header.action_size)))
    click.echo(f"wrote {out}: {layers}, {header.activation}, {header.distribution}")


@click.command("evaluate-behaviour")
@click.argument("tasks", nargs=-1, metavar="[TASK]...")
@click.option(
    "--level", "levels", multiple=True, help="expert, medium, mixed, random. Repeatable.  [default: all bundled]"
)
@click.option(
    "--behaviour",
    metavar="FILE|RUN|MODULE:FUNCTION",
    help="What to evaluate instead of the bundled policies, as in rollout.",
)
@click.option("--episodes", type=click.IntRange(2), default=100, show_default=True)
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True)
@click.option("--sample", is_flag=True, help="Sample actions instead of using the policy mean.")
@click.option("--pictures", type=OutPath(path_type=Path), help="Folder for drawings of ten paths in each maze.")
@json_option
def evaluate_behaviour(tasks, levels, behaviour, episodes, seed, sample, pictures, as_json):
    """Measure the returns of behaviour policies over fresh episodes, beside the paper's.

    Without TASK: every bundled policy and random actions. With --behaviour: that policy or run.

    \b
    dmcvb-gen evaluate-behaviour
    dmcvb-gen evaluate-behaviour walker-walk --level expert --episodes 100 --seed 1 --json
    dmcvb-gen evaluate-behaviour ant-maze-easy7x7a --level expert --level medium --pictures paths
    """
    from dmcvb_gen.errors import DmcvbError
    from dmcvb_gen.generate.info import return_statistics
    from dmcvb_gen.generate.request import behaviour_source
    from dmcvb_gen.own_code import is_own
    from dmcvb_gen.policies.actor import random_policy
    from dmcvb_gen.policies.bundled import CONVERTED, bundled_levels, levels_of, resolve_policies
    from dmcvb_gen.policies.evaluation import maze_scores, running_speed, walked_paths
    from dmcvb_gen.policies.paper import paper_returns
    from dmcvb_gen.policies.policy_file import load_policy, read_header
    from dmcvb_gen.policies.simulate import simulate
    from dmcvb_gen.spec import is_maze
    from dmcvb_gen.tasks import get_task, task_ids
    from dmcvb_gen.tasks.ant_maze.picture import save_paths_picture

    behaviour = behaviour_source(behaviour)
    if behaviour and (is_own(behaviour) or Path(behaviour).suffix in CONVERTED):
        levels = levels or ["expert"]
        if len(tasks) != 1:
            raise click.UsageError(f"Give the one TASK that {behaviour} is for.")
    elif behaviour:
        levels = levels or levels_of(behaviour)
        named = [level for level in levels if level != "random"]
        files = [path for level in named for path in resolve_policies("", level, behaviour)]
        tasks = tasks or sorted({read_header(path).task for path in files})
    tasks, rows = tasks or [task_id for task_id in task_ids() if bundled_levels(task_id)], []
    if pictures and not any(is_maze(task_id) for task_id in tasks):
        raise DmcvbError(f"--pictures shows the paths of mazes, and {', '.join(tasks)} is none; leave it out")
    for task_id in tasks:
        task, panels = get_task(task_id), {}
        for level in levels or [*bundled_levels(task_id), "random"]:
            if level == "random":
                policies = [random_policy(task)]
            else:
                policies = [load_policy(path, task) for path in resolve_policies(task_id, level, behaviour)]
            out = simulate(task, policies, range(episodes), seed, (task_id, "evaluation"), deterministic=not sample)
            row = dict(task=task_id, level=level, episodes=episodes, seed=seed)
            row |= dict(mode="sampled" if sample else "mean", returns=return_statistics(out.returns))
            success, speed = maze_scores(task, out)
            if success is not None:
                row |= dict(success=success, speed=speed, running_speed=running_speed(task, out))
                panels[f"{level}, {success:.0%} at the goal"] = walked_paths(task, out)
            rows.append(row | dict(paper=paper_returns(task_id, level)))
        if pictures and panels:
            save_paths_picture(task.layout, panels, pictures / f"{task_id}.png")
    if as_json:
        return print_json(rows)
    _show_returns(rows, episodes, seed)


def _show_returns(rows, episodes, seed):
    """Print returns, the paper's under each."""
    mazes = any("success" in row for row in rows)
    statistics = ("mean", "std", "min", "p25", "median", "p75", "max")
    scores = ("success", "to goal m/s", "rms m/s") if mazes else ()
    lines = []
    for row in rows:
        extra = [""] * len(scores)
        if "success" in row:
            speed = "-" if row["speed"] is None else f"{row['speed']:.2f}"
            extra = [f"{row['success']:.0%}", speed, f"{row['running_speed']:.2f}"]
        lines.append((row["task"], row["level"], *(f"{row['returns'][key]:.1f}" for key in statistics), *extra))
        if row["paper"]:
            numbers = [f"{row['paper'][key]:.1f}" for key in statistics]
            lines.append(("  DMC-VB paper", row["level"], *numbers, *[""] * len(scores)))
    print_table(
        ("task", "<level", *statistics, *scores),
        lines,
        title=f"{episodes} episodes each, seed {seed}, {rows[0]['mode']} actions",
        optional=(("p25", "p75"), ("rms m/s",), ("min", "max"), ("to goal m/s",)),
    )
