"""The distractors that there are: the package's own, those that users name, and those of installed packages.

To add one, write a file with a `Distractor` and a line in `BUILT_IN`. One of your own is `--distractor module:Class`,
or an entry point "dmcvb_gen.distractors" of a package.
"""

from __future__ import annotations

from importlib import metadata
from typing import Any

from dmcvb_gen import own_code
from dmcvb_gen.distractor_state import LABEL_DTYPES, OPTIONAL_LABELS
from dmcvb_gen.distractors.background import Background
from dmcvb_gen.distractors.base import Distractor
from dmcvb_gen.distractors.camera import Camera
from dmcvb_gen.distractors.color import Color
from dmcvb_gen.distractors.cue import Cue
from dmcvb_gen.distractors.light import Light
from dmcvb_gen.distractors.style import Style
from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.seeding import DISTRACTOR_STREAMS
from dmcvb_gen.spec import DISTRACTOR_ENTRY_POINTS, DISTRACTOR_KINDS, DistractorSetting, kind_of

BUILT_IN: tuple[type[Distractor], ...] = (Camera, Color, Background, Style, Cue, Light)
"""Together they give every label."""


def typed_setting(name: str) -> str:
    """A setting as a person types it: "<module>:<Class>_hard" lets that class's code run, and is "class_hard" then.

    Raises:
      DmcvbError: there is no such class, or it is no distractor.
    """
    module, colon, rest = name.partition(":")
    if not colon:
        return name
    own, _, difficulty = rest.partition("_")
    own_code.refuse_file("distractor", name)
    if own.lower() in DISTRACTOR_KINDS:
        raise DmcvbError(f"{name} has the name of the package's own {own.lower()}; give the class another")
    try:
        DistractorSetting("dynamic", difficulty or "medium")
    except UnknownNameError as error:
        raise DmcvbError(f"{name}: a difficulty follows an underscore, so classes have none; {error}") from None
    own_code.allow([f"{module}:{own}"], own_code.DISTRACTORS)
    distractors_of(DistractorSetting(own.lower()))
    return own.lower() + (f"_{difficulty}" if difficulty else "")


def distractors_of(setting: DistractorSetting) -> tuple[type[Distractor], ...]:
    """The distractors that vary under a setting, the package's own first.

    Raises:
      DmcvbError: a class of a user's own cannot be found, may not run, or is no distractor of that kind.
    """
    found = [
        part for part in BUILT_IN if not part.kinds or (setting.kind in part.kinds and setting.varies(part.stream))
    ]
    if setting.kind in DISTRACTOR_KINDS:
        return tuple(found)
    for point in metadata.entry_points(group=DISTRACTOR_ENTRY_POINTS, name=setting.kind):
        found.append(_checked(point.load(), setting.kind))
    for name in own_code.allowed(own_code.DISTRACTORS):
        if kind_of(name) == setting.kind:
            found.append(_checked(own_code.find_function(name, own_code.DISTRACTORS, "distractor"), setting.kind))
    return tuple(dict.fromkeys(found))


def _checked(distractor: Any, kind: str) -> type[Distractor]:
    kinds, names, stream = (getattr(distractor, name, None) for name in ("kinds", "names", "stream"))
    if not isinstance(distractor, type) or not issubclass(distractor, Distractor) or kind not in (kinds or ()):
        raise DmcvbError(
            f"{distractor!r} is no distractor {kind!r}; give a subclass of Distractor with kinds = ({kind!r},)"
        )
    known = [name for name in LABEL_DTYPES if name not in OPTIONAL_LABELS]
    if names is None or not set(names) <= set(known) or stream not in DISTRACTOR_STREAMS:
        raise DmcvbError(f"{distractor!r}: give names out of {known}, and a stream out of {DISTRACTOR_STREAMS}")
    return distractor
