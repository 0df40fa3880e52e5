"""Texts in Markdown as HTML: markup of their own is shown as text, and links lead to what is in the site."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from urllib.parse import unquote, urlsplit

from markdown_it import MarkdownIt
from markdown_it.token import Token

# What a link of a text may lead to outside the site.
OUTSIDE = ("http", "https")
# So short a cell stands in one line.
SHORT = 16


def rendered(text: str, target: Callable[[str], str | None]) -> str:
    """Return a text as HTML.

    Args:
        text: Markdown with tables.
        target: returns where a relative link leads to in the site; None where there is nothing.
    """
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = parser.parse(text)
    for token, after in itertools.zip_longest(tokens, tokens[1:]):
        for one in token.children or ():
            _lead(one, target)
        # The policy of the pages allows no styles in markup.
        token.attrs.pop("style", None)
        if token.type == "td_open" and len(after.content) <= SHORT:
            token.attrs["class"] = "short"
        if token.type.startswith("heading"):
            # The page has a title of its own.
            token.tag = f"h{min(int(token.tag[1:]) + 1, 6)}"
    html = str(parser.renderer.render(tokens, parser.options, {}))
    box = '<div class="wide" tabindex="0" role="region" aria-label="Table">'
    return html.replace("<table>", f"{box}<table>").replace("</table>", "</table></div>")


def _lead(token: Token, target: Callable[[str], str | None]) -> None:
    """Let a link or a picture lead to what is in the site; without it, nowhere."""
    name = {"link_open": "href", "image": "src"}.get(token.type)
    if name is None:
        return
    given = str(token.attrs[name])
    if name == "href" and (urlsplit(given).scheme in OUTSIDE or given.startswith("#")):
        return
    found = target(unquote(given.partition("#")[0]))
    if found is None:
        del token.attrs[name]
    else:
        token.attrs[name] = found
