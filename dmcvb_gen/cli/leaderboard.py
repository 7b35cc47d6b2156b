"""leaderboard."""

from __future__ import annotations

from fnmatch import fnmatchcase
from pathlib import Path

import click

from dmcvb_gen.cli.common import OutPath, json_option, print_json, print_table
from dmcvb_gen.progress import ProgressBar
from dmcvb_gen.text import pluralize


@click.command()
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False), default=Path("docs/leaderboard"))
@click.option(
    "--add", "reports", multiple=True, metavar="REPORT", help="Add the cells of a report of validate. Repeatable."
)
@click.option("--cell", "patterns", multiple=True, metavar="PATTERN", help="Add only these rows, e.g. 'walker-walk_*'.")
@click.option("--data-command", metavar="COMMAND", help="Command that made the release.  [default: its recipe's]")
@click.option("--check", is_flag=True, help="Evaluate the rows' policies again and compare the scores.")
@click.option("--row", "names", multiple=True, metavar="NAME", help="Show or check only these rows. Repeatable.")
@click.option("--write", "page", type=OutPath(path_type=Path, dir_okay=False), help="Write the page (Markdown).")
@json_option
@click.pass_context
def leaderboard(context, folder, reports, patterns, data_command, check, names, page, as_json):
    """Show a leaderboard, add rows to it, or compute its scores again.

    FOLDER holds the rows (default: docs/leaderboard): JSON with the score, the commands, seeds, digests, version and
    processor, and the trained policy beside it. --check exits with 1 if a score does not hold.

    \b
    dmcvb-gen leaderboard
    dmcvb-gen leaderboard --check --row walker-walk_none_state-bc_expert_quick_mine_seed0
    dmcvb-gen leaderboard --add reports/mine --write docs/leaderboard.md
    """
    from dmcvb_gen.benchmarks.leaderboard import add_rows, check_row, read_rows, rows_of_report, write_page

    for value, option in ((patterns, "--cell"), (data_command, "--data-command")):
        if value and not reports:
            raise click.UsageError(f"{option} has no effect without --add: remove it.")
    if reports and names and not check:
        raise click.UsageError("--row has no effect beside --add: choose what is added by --cell.")
    if page and names:
        raise click.UsageError("--write writes all rows: remove --row.")
    for report in reports:
        rows = rows_of_report(report, data_command or "")
        chosen = {
            name: entry
            for name, entry in rows.items()
            if not patterns or any(fnmatchcase(name, pattern) for pattern in patterns)
        }
        if not chosen:
            raise click.UsageError(f"No row of {report} matches --cell; its rows are: {', '.join(rows)}")
        added = add_rows(folder, chosen)
        if not as_json:
            click.echo(f"{folder}: added {pluralize(len(added), 'rows')} of {report}.")
    rows = read_rows(folder, names)
    if page:
        write_page(page, rows, folder)
        if not as_json:
            click.echo(f"Wrote {page}.")
    checks = []
    if check:
        with ProgressBar(not as_json, total=len(rows), unit=" rows", desc="evaluation") as bar:
            for row in rows:
                bar(row.name)
                checks.append(check_row(folder, row))
                if not as_json:
                    with ProgressBar.external_write_mode():
                        click.echo(f"{_VERDICTS[checks[-1].holds]} {row.name}: {checks[-1].why}")
    if as_json:
        found = {one.row.name: {"holds": one.holds, "why": one.why, "now": one.returns} for one in checks}
        print_json([{"name": row.name, **row.model_dump(), **found.get(row.name, {})} for row in rows])
    elif not (check or page or reports):
        _show(rows)
    context.exit(1 if any(one.holds is False for one in checks) else 0)


_VERDICTS = {True: "holds", False: "DOES NOT HOLD", None: "not checked"}


def _show(rows):
    columns = ("evaluated on", "<agent", "<learned from", "return", "+-", "paper", "<training", "seed", "<policy")
    print_table(
        columns,
        [
            (
                f"{row.task}/{row.setting}",
                row.agent,
                f"{row.data}, {pluralize(row.data_episodes, 'episodes')}",
                f"{row.mean:.1f}",
                f"{row.stderr:.1f}",
                "-" if row.paper is None else f"{row.paper:.0f}",
                row.trained,
                str(row.seed),
                "yes" if row.policy else "no",
            )
            for row in rows
        ],
        optional=(("policy",), ("seed", "training")),
    )
