"""The `dmcvb-gen` command. Each sub-command calls one public function, which is imported when it is called."""

from __future__ import annotations

import _thread
import importlib
import logging
import signal
import sys
import threading
import warnings
from typing import NoReturn

import click

from dmcvb_gen.cli.common import INTERRUPTED
from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.extras import install_hint
from dmcvb_gen.options import at_terminal
from dmcvb_gen.text import printable
from dmcvb_gen.version import __version__

GROUPS = {
    "Make data": {
        "rollout": ("rollout:rollout", "Roll out behaviour policies into a release of episodes."),
        "cluster": ("rollout:cluster", "Make a release on many machines: begin, part, finish."),
        "paint": ("paint:paint", "Render the images of a release stored without pixels."),
        "repaint": ("release:repaint", "Render stored episodes with other distractors, size or renderer."),
        "regenerate": ("release:regenerate", "Check, repair or copy a release by regenerating its shards."),
    },
    "Train policies": {
        "train-behaviour": ("behaviours:train_behaviour", "Train a behaviour policy online on states."),
        "select-checkpoints": ("behaviours:select_checkpoints", "Pick the expert, medium and mixed checkpoints."),
        "evaluate-behaviour": ("behaviours:evaluate_behaviour", "Measure the returns of behaviour policies."),
    },
    "Look and check": {
        "list": ("look:list_command", "List tasks, levels, distractors, recipes and renderers."),
        "info": ("look:info", "Show subsets, size and returns of a release; the paper's returns."),
        "preview": ("view:preview", "Write a contact sheet and a video of a release."),
        "view": ("view:view", "Write one HTML file that plays the episodes of a release."),
        "verify": ("release:verify", "Check every file, value, state and image of a release."),
        "validate": ("validate:validate", "Train the paper's agents on a release and report their scores."),
    },
    "Share": {
        "card": ("view:card", "Write the card of a release: README.md, croissant.json, images."),
        "publish": ("release:publish", "Upload a release: s3://, gs://, az://, hf:// or file:."),
        "fetch": ("paint:fetch", "Download a published release, or a part of it."),
    },
    "Convert": {
        "convert-policy": ("behaviours:convert_policy", "Convert a policy of Stable-Baselines3 or torch (CleanRL)."),
        "export": ("release:export", "Write subsets as HDF5, Minari, LeRobot, RLDS, Zarr, ..."),
        "import": ("view:import_command", "Import DMC-VB's published TFDS folders into a release."),
    },
}
"""Heading -> command -> ("module:attribute" under `dmcvb_gen.cli`, short help)."""
COMMANDS = {name: entry for commands in GROUPS.values() for name, entry in commands.items()}
"""Command -> ("module:attribute", short help)."""


RESUMING = frozenset({"rollout", "cluster", "paint", "repaint", "validate", "publish", "fetch", "export", "import"})
"""Commands that keep what they finished, and go on from there when they are run again."""


class LazyGroup(click.Group):
    """Imports a command's module only when it is called, so that --help is quick; prints errors in one line."""

    def list_commands(self, ctx):
        return list(COMMANDS)

    def get_command(self, ctx, name):
        if name not in COMMANDS:
            raise UnknownNameError("command", name, COMMANDS)
        module, attribute = COMMANDS[name][0].split(":")
        return getattr(importlib.import_module(f"dmcvb_gen.cli.{module}"), attribute)

    def make_context(self, *args, **kwargs):
        try:
            return super().make_context(*args, **kwargs)
        except click.exceptions.NoArgsIsHelpError:
            raise
        except click.UsageError as error:
            click.echo(f"error: {printable(_wrong_usage(error))}", err=True)
            raise click.exceptions.Exit(error.exit_code) from None

    def format_commands(self, ctx, formatter):
        for heading, commands in GROUPS.items():
            with formatter.section(heading):
                formatter.write_dl([(name, text) for name, (_, text) in commands.items()], col_max=20)

    def invoke(self, ctx):
        _asked_to_stop.clear()
        named = at_terminal.set(True)
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            _end_interrupted(ctx)
        except click.exceptions.NoArgsIsHelpError:
            raise
        except Exception as error:
            if _asked_to_stop.is_set():  # Ctrl-C within foreign code comes out as that code's own kind of error
                _end_interrupted(ctx)
            what = str(error) if isinstance(error, DmcvbError) else None
            if isinstance(error, click.UsageError):
                what = _wrong_usage(error)
            if isinstance(error, ModuleNotFoundError):
                what = install_hint(error.name or "")
            if what is None:
                raise
            click.echo(f"error: {printable(what)}", err=True)
            ctx.exit(2)
        finally:
            at_terminal.reset(named)


@click.group("dmcvb-gen", cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="dmcvb-gen")
def main():
    """Make, check, share and use DMC-VB style data sets.

    \b
    dmcvb-gen rollout walker-walk --level expert --episodes 8 --out releases/demo
    dmcvb-gen preview releases/demo
    """
    _stop_on_signals(click.get_current_context())


_asked_to_stop = threading.Event()


def _wrong_usage(error: click.UsageError) -> str:
    """Say in one line what is wrong with a command line. Messages of click get the help to read; ours name the cure."""
    command = error.ctx.command_path if error.ctx else "dmcvb-gen"
    ours = type(error) is click.UsageError and not error.message.startswith("Got unexpected")
    message = error.format_message().rstrip(".?")
    message = message[:1].lower() + message[1:]
    return error.message if ours else f"{message}; see `{command} --help`"


def _end_interrupted(context: click.Context) -> NoReturn:
    resumes = context.invoked_subcommand in RESUMING
    how = " What is finished is kept; rerun the same command to go on." if resumes else ""
    click.echo(f"\nInterrupted.{how}", err=True)
    context.exit(INTERRUPTED)


def _stop_again(lost: sys.UnraisableHookArgs) -> None:
    """Send Ctrl-C again a moment later if Python has dropped it, as it does within a destructor."""
    if lost.exc_type is KeyboardInterrupt:
        threading.Timer(0.1, _thread.interrupt_main).start()


def _stop_on_signals(context: click.Context) -> None:
    """SIGTERM ends a command as Ctrl-C does: its workers stop with it, what is finished stays."""

    def stop(*_):
        _asked_to_stop.set()
        sys.unraisablehook = _stop_again  # what is half begun (an event loop, say) has nothing to tell any more
        logging.getLogger("asyncio").disabled = True  # nor have the tasks of that loop
        warnings.simplefilter("ignore")
        raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
        context.call_on_close(lambda: [signal.signal(number, handler) for number, handler in before.items()])
