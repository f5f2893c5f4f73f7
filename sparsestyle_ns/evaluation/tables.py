"""Figures set out in tables, for a terminal and for pages."""

from dataclasses import dataclass, field
from typing import Dict, List, Optional, Sequence, Tuple

from rich.console import Console
from rich.table import Column
from rich.table import Table as RichTable

from sparsestyle_ns.metrics.art_fid import why_left_out

LABELS: Dict[str, Tuple[str, int]] = {
    "psnr": ("PSNR dB ↑", 2),
    "ssim": ("SSIM ↑", 3),
    "lpips": ("LPIPS ↓", 3),
    "st_lpips": ("ST-LPIPS ↓", 4),
    "rmse": ("RMSE ↓", 3),
    "visible": ("pixels that count", 3),
    "effective_samples": ("effective samples a ray ↓", 2),
    "style_loss": ("NNFM to the style ↓", 4),
    "gram_distance": ("Gram distance to the style ↓", 4),
    "texture_distance": ("texture distance to the style ↓", 3),
    "color_distance": ("colour distance to the style ↓", 3),
    "colors_used": ("share of its colours used ↑", 2),
    "features_used": ("share of its features used ↑", 2),
    "stroke_width": ("stroke width, pixels", 1),
    "art_fid": ("ArtFID ↓", 2),
    "content_loss": ("feature distance to the content ↓", 3),
    "content_ssim": ("SSIM to the photo ↑", 3),
    "unstylised_ssim": ("SSIM to the unstylised view ↑", 3),
    "baked_psnr": ("baked to exact, PSNR dB ↑", 1),
}
"""A figure's name in words, with the direction that is better, and its decimals."""
COARSE_QUALITY = ("psnr", "ssim", "lpips", "st_lpips", "effective_samples")
STYLE_DISTANCES = ("style_loss", "gram_distance", "texture_distance", "color_distance")
STYLE = (*STYLE_DISTANCES, "colors_used", "features_used", "stroke_width")
"""Figures that an unstylised view has too."""
STYLE_AND_CONTENT = (*STYLE, "art_fid", "content_loss")
PERCEPTUAL = ("rmse", "ssim", "lpips", "st_lpips")
CONSISTENCY = [(f"{part}_{kind}", kind, f"{part} ") for part in ("short", "long") for kind in PERCEPTUAL]
"""Columns of short- and long-range consistency, for `table_of`."""

LEAST_WIDTH = 9
"""Characters that a column needs, so that its figures and most words of its heading are whole."""


@dataclass
class Table:
    """A table of figures."""

    title: str
    columns: Sequence[str]
    """Headings of the columns after the first."""
    rows: List[Tuple[str, List[Optional[str]]]] = field(default_factory=list)
    """Each row's name and cells; None is an empty one."""
    note: str = ""
    """A sentence below it."""
    cited: Tuple[str, ...] = ()
    """Names of rows whose figures are others', not measured here."""

    def print(self) -> None:
        """Prints it; with rows as columns where it has more columns than fit beside each other."""
        console = Console()
        wide = LEAST_WIDTH * (1 + len(self.columns)) > console.width
        console.print(self._turned() if wide and len(self.rows) < len(self.columns) else self._upright())

    def _upright(self) -> RichTable:
        printed = self._with_columns(self.columns)
        for name, cells in self.rows:
            printed.add_row(name, *(cell or "–" for cell in cells), style="italic dim" if name in self.cited else None)
        return printed

    def _turned(self) -> RichTable:
        printed = self._with_columns([name for name, _ in self.rows])
        for place, name in enumerate(self.columns):
            printed.add_row(name, *(cells[place] or "–" for _, cells in self.rows))
        return printed

    def _with_columns(self, names: Sequence[str]) -> RichTable:
        words = {"title": self.title, "caption": self.note or None}
        columns = [Column(name, justify="right") for name in names]
        return RichTable("", *columns, **words, title_justify="left", caption_justify="left")


def table_of(
    title: str,
    columns: Sequence[Tuple[str, str, str]],
    rows: Sequence[Tuple[str, Dict[str, Optional[float]]]],
    note: str = "",
) -> Table:
    """A table of some of each row's figures; columns that no row has a figure for are left out.

    Args:
        columns: of each the figure's key in a row, its kind (a key of `LABELS`), and words before the kind's label.
        rows: of each its name and figures.
    """
    shown = [column for column in columns if any(figures.get(column[0]) is not None for _, figures in rows)]
    table = Table(title, [f"{words}{LABELS[kind][0]}" for _, kind, words in shown], note=note)
    for name, figures in rows:
        values = [(figures.get(key), LABELS[kind][1]) for key, kind, _ in shown]
        table.rows.append((name, [None if value is None else f"{value:.{digits}f}" for value, digits in values]))
    return table


def report_tables(means: Dict[str, float], num_views: int) -> List[Table]:
    """The tables of one run's figures, as `sparsestyle evaluate` prints them."""
    views = f"{num_views} held-out view" + "s" * (num_views > 1)
    prefix = "coarse_" if "coarse_psnr" in means else ""
    quality = [(f"{prefix}{key}", key, "") for key in COARSE_QUALITY]
    tables = [table_of(f"Coarse field, {views}", quality, [("coarse", means)])]
    if not prefix:
        return tables
    style = [(key, key, "") for key in STYLE]
    kept = [(key, key, "") for key in ("art_fid", "content_loss", "unstylised_ssim", "content_ssim", "baked_psnr")]
    before = {key: means.get(f"{key}_before") for key in STYLE}
    rows = [("unstylised", before), ("stylised", means)]
    tables.append(table_of(f"Style, {views}", style, rows))
    tables.append(table_of(f"Content, {views}", kept, [("stylised", means)], why_left_out(means)))
    if "short_rmse" in means:
        ceiling = {key[len("ceiling_") :]: value for key, value in means.items() if key.startswith("ceiling_")}
        columns = [*CONSISTENCY, *((f"{part}_visible", "visible", f"{part} ") for part in ("short", "long"))]
        rows = [("stylised", means), ("unstylised (the ceiling)", ceiling)]
        tables.append(table_of("Consistency on the measuring path, frames t and t + 1, t and t + 7", columns, rows))
    return tables
