"""The distractors that there are: the package's own, those that users register, and those of installed packages.

To add one, write a file with a `DistractorPart` and a line in `BUILT_IN`. In a package of your own, decorate the class
with `register_distractor`, or name it in the entry points "dmcvb_gen.distractors"; see docs/extending.md.
"""

from __future__ import annotations

from importlib import metadata

from dmcvb_gen import seeding
from dmcvb_gen.distractor_state import DISTRACTOR_STATE_NAMES, OPTIONAL_LABELS
from dmcvb_gen.distractors.background import Background
from dmcvb_gen.distractors.base import KINDS, Distractor, DistractorPart
from dmcvb_gen.distractors.camera import Camera
from dmcvb_gen.distractors.color import Color
from dmcvb_gen.distractors.cue import Cue
from dmcvb_gen.distractors.light import Light
from dmcvb_gen.distractors.shake import Shake
from dmcvb_gen.distractors.style import Style
from dmcvb_gen.spec import DISTRACTOR_ENTRY_POINTS, own_distractors

BUILT_IN: tuple[type[DistractorPart], ...] = (Camera, Color, Background, Style, Cue, Shake, Light)
"""Together they give every label."""
_registered: dict[str, tuple[type[DistractorPart], ...]] = {}


def register_distractor(distractor: type[DistractorPart]) -> type[DistractorPart]:
    """Class decorator: make a distractor's kinds known, so that `--distractor KIND` and recipes take them.

    Raises:
      ValueError: a kind is taken or no plain word, or a label or the stream is unknown.
    """
    for kind in distractor.kinds:
        taken = kind in KINDS or distractor in _registered.get(kind, ())
        if taken or not kind.replace("-", "").isalnum():
            raise ValueError(f"distractor kind {kind!r}: give a new word of letters, digits and '-'")
    if unknown := set(distractor.names) - set(DISTRACTOR_STATE_NAMES):
        raise ValueError(f"labels {sorted(unknown)} are not among {DISTRACTOR_STATE_NAMES}")
    if optional := set(distractor.names) & OPTIONAL_LABELS.keys():
        raise ValueError(f"label {', '.join(optional)} is stored only if `light` varies: use --vary light")
    if distractor.stream not in seeding.STREAMS:
        raise ValueError(f"stream {distractor.stream!r} is not one of {seeding.STREAMS}")
    for kind in distractor.kinds:
        _registered[kind] = (*_registered.get(kind, ()), distractor)
        own_distractors.add(kind)
    return distractor


def distractors_of(setting: Distractor) -> tuple[type[DistractorPart], ...]:
    """The distractors that vary under a setting, the package's own first."""
    if setting.kind not in (*KINDS, *_registered):
        for point in metadata.entry_points(group=DISTRACTOR_ENTRY_POINTS, name=setting.kind):
            distractor = point.load()
            if setting.kind not in _registered:  # the class may have registered itself on import
                register_distractor(distractor)
    own = tuple(
        part for part in BUILT_IN if not part.kinds or (setting.kind in part.kinds and setting.varies(part.stream))
    )
    return own + _registered.get(setting.kind, ())
