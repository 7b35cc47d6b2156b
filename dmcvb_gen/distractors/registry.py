"""The distractors that there are: the package's own, those that users register, and those of installed packages.

To add one, write a file with a `Distractor` and a line in `BUILT_IN`. One of your own is `--distractor module:Class`;
or decorate the class with `register_distractor`, or name it in the entry points "dmcvb_gen.distractors" of a package.
"""

from __future__ import annotations

from importlib import metadata
from typing import Any

from dmcvb_gen import own_code, seeding
from dmcvb_gen.distractor_state import DISTRACTOR_STATE_NAMES, OPTIONAL_LABELS
from dmcvb_gen.distractors.background import Background
from dmcvb_gen.distractors.base import Distractor
from dmcvb_gen.distractors.camera import Camera
from dmcvb_gen.distractors.color import Color
from dmcvb_gen.distractors.cue import Cue
from dmcvb_gen.distractors.light import Light
from dmcvb_gen.distractors.shake import Shake
from dmcvb_gen.distractors.style import Style
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.spec import DISTRACTOR_ENTRY_POINTS, DISTRACTOR_KINDS, DistractorSetting, kind_of, own_distractors

BUILT_IN: tuple[type[Distractor], ...] = (Camera, Color, Background, Style, Cue, Shake, Light)
"""Together they give every label."""
_registered: dict[str, tuple[type[Distractor], ...]] = {}


def register_distractor(distractor: type[Distractor]) -> type[Distractor]:
    """Class decorator: make a distractor's kinds known, so that `--distractor KIND` and recipes take them.

    Raises:
      ValueError: a kind is taken or no plain word, or a label or the stream is unknown.
    """
    for kind in distractor.kinds:
        taken = kind in DISTRACTOR_KINDS or distractor in _registered.get(kind, ())
        if taken or not kind.replace("-", "").isalnum():
            raise ValueError(f"distractor kind {kind!r}: give a new word of letters, digits and '-'")
    if unknown := set(distractor.names) - set(DISTRACTOR_STATE_NAMES):
        raise ValueError(f"labels {sorted(unknown)} are not among {DISTRACTOR_STATE_NAMES}")
    if optional := set(distractor.names) & OPTIONAL_LABELS.keys():
        raise ValueError(f"label {', '.join(optional)} is stored only if `light` varies: use dynamic_light")
    if distractor.stream not in seeding.STREAMS:
        raise ValueError(f"stream {distractor.stream!r} is not one of {seeding.STREAMS}")
    for kind in distractor.kinds:
        _registered[kind] = (*_registered.get(kind, ()), distractor)
        own_distractors.add(kind)
    return distractor


def _register_once(distractor: Any, kind: str) -> None:
    """Register a class for one of its kinds, if it has not registered itself on import."""
    if not isinstance(distractor, type) or not issubclass(distractor, Distractor) or kind not in distractor.kinds:
        raise DmcvbError(
            f"{distractor!r} is no distractor {kind!r}; give a subclass of Distractor with kinds = ({kind!r},)"
        )
    if kind not in _registered:
        register_distractor(distractor)


def typed_setting(name: str) -> str:
    """A setting as a person types it: "<module>:<Class>_hard" lets that class's code run, and is "class_hard" then.

    Raises:
      DmcvbError: there is no such class, or it is no distractor.
    """
    module, colon, rest = name.partition(":")
    if not colon:
        return name
    own, _, difficulty = rest.partition("_")
    own_code.allow([f"{module}:{own}"], own_code.DISTRACTORS)
    distractors_of(DistractorSetting(own.lower()))
    return own.lower() + (f"_{difficulty}" if difficulty else "")


def distractors_of(setting: DistractorSetting) -> tuple[type[Distractor], ...]:
    """The distractors that vary under a setting, the package's own first."""
    if setting.kind not in (*DISTRACTOR_KINDS, *_registered):
        for point in metadata.entry_points(group=DISTRACTOR_ENTRY_POINTS, name=setting.kind):
            _register_once(point.load(), setting.kind)
        for name in own_code.allowed(own_code.DISTRACTORS):
            if kind_of(name) == setting.kind:
                _register_once(own_code.find_function(name, own_code.DISTRACTORS, "distractor"), setting.kind)
    own = tuple(
        part for part in BUILT_IN if not part.kinds or (setting.kind in part.kinds and setting.varies(part.stream))
    )
    return own + _registered.get(setting.kind, ())
