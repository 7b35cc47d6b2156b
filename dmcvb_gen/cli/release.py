"""verify."""

from __future__ import annotations

import dataclasses

import click
from tqdm import tqdm

from dmcvb_gen.cli.common import json_option, print_json


@click.command()
@click.argument("path")
@click.option("--backgrounds", metavar="FOLDER", help="Where the release's background videos are now, if they moved.")
@json_option
@click.pass_context
def verify(context, path, backgrounds, as_json):
    """Check that a release is what it says: digests, shapes, values, physics, pixels, returns.

    Exit code 0 when sound, 1 when a check fails, 2 on bad usage.

    \b
    dmcvb-gen verify releases/demo
    """
    from dmcvb_gen.release.verify import verify as run

    with tqdm(unit=" subsets", disable=as_json or None) as bar:
        result = run(path, backgrounds, lambda name: (bar.set_description(name), bar.update()))
    if as_json:
        findings = [dataclasses.asdict(finding) for finding in result.findings]
        print_json({"sound": result.sound, "checked": result.checked, "findings": findings})
    else:
        for finding in result.findings[:50]:
            click.echo(f"FAIL {finding}")
        if len(result.findings) > 50:
            click.echo(f"... and {len(result.findings) - 50} more")
        checked = ", ".join(f"{count:,} {name}" for name, count in result.checked.items())
        click.echo(f"{path}: {'sound' if result.sound else f'{len(result.findings)} findings'} ({checked})")
    context.exit(0 if result.sound else 1)
