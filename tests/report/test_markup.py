"""Data stays data: no text can end an element, open one, or end a script."""

from __future__ import annotations

import json

import pytest

from synpick_warp.apps.report.markup import Html, content_hash, element, embed_json, join, printable

NAMES = [
    "</script><script>alert(1)</script>",
    "<!--<script>",
    '" onload="alert(1)',
    "&lt;b&gt;",
    "\u2028\u2029",
    "]]>",
    "\ud800",
    "\x1b[31m\x00",
]


def test_known_elements():
    assert element("p", "a < b & c") == "<p>a &lt; b &amp; c</p>"
    assert (
        element("a", element("b", "x"), "y", href='#"', class_="q", data_kind="z")
        == '<a href="#&quot;" class="q" data-kind="z"><b>x</b>y</a>'
    )
    assert element("ul", [element("li", "1"), "<"]) == "<ul><li>1</li>&lt;</ul>"
    assert join(["<", Html("<br>")]) == "&lt;<br>"


@pytest.mark.parametrize("name", NAMES)
def test_names_are_text(name):
    written = element("p", name, title=name)
    assert written.count("<") == 2
    assert written.count('"') == 2
    written.encode("utf-8")
    assert all(letter.isprintable() or letter == "\n" for letter in printable(name))


@pytest.mark.parametrize("name", NAMES)
def test_embedded_json_cannot_end_its_element_and_is_read_back(name):
    written = embed_json({name: [name]})
    assert not {"<", ">", "&", "\u2028", "\u2029"} & set(written)
    assert json.loads(written) == {name: [name]}


def test_a_hash_is_that_of_the_policy():
    # The example of the CSP specification, level 3, section 8.4.
    assert content_hash("alert('Hello, world.');") == "'sha256-qznLcsROx4GACP2dm0UCKCzCG+HiZ1guq6ZZDob/Tng='"
