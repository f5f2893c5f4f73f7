"""Tables of figures are whole in a terminal of any width."""

import pytest

from sparsestyle_ns.evaluation.tables import Table, table_of

COLUMNS = [
    (key, key, "") for key in ("style_loss", "gram_distance", "texture_distance", "color_distance", "stroke_width")
]
FIGURES = {key: 0.125 for key, _, _ in COLUMNS}


@pytest.mark.parametrize("width", [50, 200])
def test_figures_are_whole_however_narrow_the_terminal_is(width, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(width))
    table_of("Style", COLUMNS, [("unstylised", FIGURES), ("stylised", {**FIGURES, "style_loss": 0.0625})]).print()
    lines = capsys.readouterr().out.splitlines()
    # A row of its own where rows have become columns.
    assert any("NNFM" in line and "0.0625" in line for line in lines) is (width == 50)
    assert sum(line.count("0.125") for line in lines) == 7  # of three or four decimals
    assert "…" not in "".join(lines)


def test_a_missing_figure_is_a_dash_either_way(monkeypatch, capsys):
    table = Table("Some", ["a heading", "another", "a third", "a fourth"], [("one", ["1.0", None, "2.0", None])])
    for width in ("30", "200"):
        monkeypatch.setenv("COLUMNS", width)
        table.print()
        assert capsys.readouterr().out.count("–") == 2
