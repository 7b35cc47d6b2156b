"""Fill the templates of a card: Markdown in which no text of a release becomes markup, and JSON."""

from __future__ import annotations

import json
from typing import Any

from dmcvb_gen.text import printable, quoted

MARKUP = str.maketrans({character: f"&#{ord(character)};" for character in "<>&[]|"})
"""Characters of which Markdown makes elements, links and cells -> the same characters as entities."""


class Safe(str):
    """A text that is Markdown already."""


def fill(name: str, **values: Any) -> str:
    """A template of `release/data`. In Markdown, values are escaped unless the template calls them safe."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    def escaped(value: object) -> object:
        if isinstance(value, Safe) or not name.endswith(".md.jinja"):
            return value
        return printable(str(value), line=" ").translate(MARKUP)  # one line that is no HTML, no link and no cell

    layout: dict[str, Any] = dict(trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    loader = PackageLoader("dmcvb_gen.release", "data")
    environment = Environment(loader=loader, undefined=StrictUndefined, finalize=escaped, **layout)
    environment.filters["safe"] = Safe
    environment.filters["python"] = lambda text: Safe(json.dumps(printable(text, line=" ")))
    environment.filters["shell"] = lambda text: Safe(quoted(printable(text, line=" ")))
    return environment.get_template(name).render(**values)
