"""Tables as text and LaTeX: columns of wide letters, headers above several columns, gaps and blocks; CSV with and without exact names."""

from __future__ import annotations

from synpick_warp.system.codecs.tables import Column, Table, to_csv, to_latex, to_text

TABLE = Table(
    "t",
    "",
    (Column("name", label=""), Column("a_b", ",", digits=".3g"), Column("c", ".1f"), Column("d", ".1f")),
    [("x_1", 1234, 0.25, None), ("=日本", None, 2.0, 3.0)],
    spans=(("a method", range(1, 3)), ("m", range(3, 4))),
    sections=frozenset({1}),
)


def test_text_is_aligned_and_split_into_blocks():
    whole = ["       a method    m", "         a b    c    d", "x_1    1,234  0.2    -", "", "=日本      -  2.0  3.0"]
    assert list(to_text(TABLE)) == [whole]
    narrow = [["         a b    c", "x_1    1,234  0.2", "", "=日本      -  2.0"], ["         d", "x_1      -", "", "=日本  3.0"]]
    assert list(to_text(TABLE, 18)) == narrow


def test_latex_has_rules_and_escaped_names():
    assert to_latex(TABLE).splitlines()[2:8] == [
        r" & \multicolumn{2}{c}{a method} & \multicolumn{1}{c}{m} \\",
        r"\cmidrule(lr){2-3}\cmidrule(lr){4-4}",
        r" & a b & c & d \\",
        r"x\_1 & 1,234 & 0.2 & -- \\",
        r"\midrule",
        r"=日本 & -- & 2.0 & 3.0 \\",
    ]


def test_names_in_csv_cannot_become_formulas_unless_they_are_to_stay_exact():
    assert to_csv(TABLE) == "name,a_b,c,d\nx_1,1.23e+03,0.25,\n'=日本,,2.0,3.0\n"
    assert to_csv(Table("names", "", (Column("name"),), [("[red]x",), ("\x1b[2J",)])) == "name\n[red]x\n\\x1b[2J\n"
    assert to_csv(TABLE, exact=True) == "name,a_b,c,d\nx_1,1.23e+03,0.25,\n=日本,,2.0,3.0\n"
