"""The `dmcvb-gen` command: each sub-command is a thin face over a public function, loaded when called."""

from __future__ import annotations

import importlib
import sys

import click

from dmcvb_gen import __version__
from dmcvb_gen.errors import DmcvbError

COMMANDS = {
    "rollout": "rollout:rollout",
    "info": "rollout:info",
    "preview": "rollout:preview",
    "list": "rollout:list_command",
    "backgrounds": "backgrounds:backgrounds",
    "train-behaviour": "behaviours:train_behaviour",
    "select-checkpoints": "behaviours:select_checkpoints",
    "evaluate-behaviour": "behaviours:evaluate_behaviour",
    "show-maze": "maze:show_maze",
    "validate": "validate:validate",
    "verify": "release:verify",
    "regenerate": "release:regenerate",
    "repaint": "release:repaint",
    "card": "release:card",
    "publish": "release:publish",
    "fetch": "release:fetch",
    "export": "release:export",
    "import": "release:import_command",
}
"""Command -> "module:attribute" under `dmcvb_gen.cli`."""


class LazyGroup(click.Group):
    """Imports a command's module only when it is called, so that --help is quick; prints errors in one line."""

    def list_commands(self, ctx):
        return list(COMMANDS)

    def get_command(self, ctx, name):
        if name not in COMMANDS:
            return None
        module, attribute = COMMANDS[name].split(":")
        return getattr(importlib.import_module(f"dmcvb_gen.cli.{module}"), attribute)

    def invoke(self, ctx):
        try:
            return super().invoke(ctx)
        except DmcvbError as error:
            click.echo(f"error: {error}", err=True)
            ctx.exit(2)


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="dmcvb-gen")
def main():
    """Make, check, share and use DMC-VB style data sets.

    \b
    dmcvb-gen rollout walker-walk --level random --distractor dynamic --episodes 8 --out releases/demo
    dmcvb-gen preview releases/demo
    """


if __name__ == "__main__":
    sys.exit(main())
