"""The `dmcvb-gen` command: each sub-command is a thin face over a public function, loaded when called."""

from __future__ import annotations

import importlib
import signal
import sys
import threading
import warnings

import click

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.extras import cure
from dmcvb_gen.version import __version__

COMMANDS = {
    "rollout": ("rollout:rollout", "Roll out behaviour policies into a release of painted episodes."),
    "status": ("cluster:status", "Show how far a release is that is being made, here or on many machines."),
    "info": ("rollout:info", "Show what a release holds, returns beside the paper's."),
    "preview": ("rollout:preview", "Write a contact sheet and a video of a release."),
    "view": ("view:view", "Write one HTML file that plays the episodes of a release."),
    "show-maze": ("maze:show_maze", "Picture a maze, its distances to a goal and the path there."),
    "list": ("rollout:list_command", "List tasks, levels, distractors, behaviours, recipes, renderers."),
    "verify": ("release:verify", "Check that a release is what it says."),
    "validate": ("validate:validate", "Check a release, run the paper's benchmarks, report both."),
    "claims": ("validate:claims", "Test the paper's claims, and the rank of its scores, on reports of validate."),
    "regenerate": ("release:regenerate", "Make a release again from its manifest: check, repair or beside."),
    "paint": ("paint:paint", "Fill in the pictures of a release that travelled without."),
    "repaint": ("release:repaint", "New pixels from stored physics states: distractor, size, renderer."),
    "diff": ("release:diff_command", "Which subsets, episodes and digests differ between two releases."),
    "card": ("release:card", "Write a release's card: README.md, croissant.json, pictures."),
    "publish": ("release:publish", "Put a release at a URL: s3://, gs://, hf://, file: or any other of fsspec."),
    "fetch": ("fetch:fetch", "Bring a published release, or a part of it."),
    "export": ("release:export", "Write subsets in another format: HDF5, npz, Minari, LeRobot, RLDS, Zarr 2."),
    "import": ("release:import_command", "Import DMC-VB's published TFDS folders into a release."),
    "backgrounds": ("backgrounds:backgrounds", "Make background clips of falling objects."),
    "train-behaviour": ("behaviours:train_behaviour", "Train a behaviour policy online on states."),
    "select-checkpoints": ("behaviours:select_checkpoints", "Pick a run's expert, medium and mixed checkpoints."),
    "evaluate-behaviour": ("behaviours:evaluate_behaviour", "Returns of behaviour policies, beside the paper's."),
}
"""Command -> ("module:attribute" under `dmcvb_gen.cli`, short help)."""


ALIASES = {"questions": "claims"}
"""Earlier name of a command -> its name."""


class LazyGroup(click.Group):
    """Imports a command's module only when it is called, so that --help is quick; prints errors in one line."""

    def list_commands(self, ctx):
        return list(COMMANDS)

    def get_command(self, ctx, name):
        name = ALIASES.get(name, name)
        if name not in COMMANDS:
            return None
        module, attribute = COMMANDS[name][0].split(":")
        return getattr(importlib.import_module(f"dmcvb_gen.cli.{module}"), attribute)

    def format_commands(self, ctx, formatter):
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in COMMANDS.items()])

    def invoke(self, ctx):
        _asked_to_stop.clear()
        try:
            return super().invoke(ctx)
        except Exception as error:
            if _asked_to_stop.is_set():  # Ctrl-C within foreign code comes out as that code's own kind of error
                raise click.Abort() from None
            what = str(error) if isinstance(error, DmcvbError) else None
            if isinstance(error, ModuleNotFoundError):
                what = cure(error.name or "")
            if what is None:
                raise
            click.echo(f"error: {what}", err=True)
            ctx.exit(2)


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="dmcvb-gen")
def main():
    """Make, check, share and use DMC-VB style data sets.

    \b
    dmcvb-gen rollout walker-walk --level random --distractor dynamic --episodes 8 --out releases/demo
    dmcvb-gen preview releases/demo
    """
    _stop_on_signals(click.get_current_context())


_asked_to_stop = threading.Event()


def _stop_on_signals(context: click.Context) -> None:
    """SIGTERM ends a command as Ctrl-C does: its workers stop with it, what is finished stays."""

    def stop(*_):
        _asked_to_stop.set()
        sys.unraisablehook = lambda *_: None  # what is half begun (an event loop, say) has nothing to tell any more
        warnings.simplefilter("ignore")
        raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
        context.call_on_close(lambda: [signal.signal(number, handler) for number, handler in before.items()])


if __name__ == "__main__":
    sys.exit(main())
