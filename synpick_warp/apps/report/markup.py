"""HTML and JSON that data cannot break out of: text is escaped when it becomes markup, JSON when it is embedded in a script element."""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Iterable
from typing import Any


class Html(str):
    """Finished markup; every other string is text."""

    __slots__ = ()


def element(tag: str, *children: str | Iterable[str], **attributes: str) -> Html:
    """An HTML element.

    Args:
        tag: Its name, never from data.
        children: `Html`, or text, which is escaped.
        attributes: Values are escaped; a trailing underscore of a name is dropped, so `class_`; others become hyphens.
    """
    written = "".join(
        f' {name.removesuffix("_").replace("_", "-")}="{html.escape(printable(value))}"' for name, value in attributes.items()
    )
    return Html(f"<{tag}{written}>{''.join(_markup(child) for child in children)}</{tag}>")


def image(kind: str, data: str, text: str) -> Html:
    """An HTML image with its content; `kind` as in its media type, `data` in Base64, `text` for those who do not see it."""
    return Html(f'<img src="data:image/{kind};base64,{data}" alt="{html.escape(printable(text))}">')


def join(parts: Iterable[str]) -> Html:
    """Concatenate markup and texts (escaped)."""
    return Html("".join(map(_markup, parts)))


def _markup(child: str | Iterable[str]) -> str:
    """HTML of a child: text is escaped, HTML stays as it is, iterables are joined."""
    if isinstance(child, Html):
        return child
    return html.escape(printable(child)) if isinstance(child, str) else join(child)


def printable(text: str) -> str:
    """Replace characters that no page may have: lone surrogates, and control characters other than line breaks."""
    return "".join(letter if letter.isprintable() or letter in "\n\t " else "�" for letter in text)


def embed_json(content: Any) -> Html:
    """JSON for a script element: the characters that could end it, or begin a comment in it, are escaped."""
    text = json.dumps(content, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return Html(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def content_hash(text: str) -> str:
    """Source expression of a Content-Security-Policy that allows an inline script or style of exactly this text."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
