"""What HTML pages of this package have in common: one file that needs nothing else, light or dark."""

import base64
import io
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Collection, Optional, Sequence

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from sparsestyle_ns.utils.output_file import prepare_output, write_output

Pixels = UInt8[np.ndarray, "H W 3"]

LOSSLESS_PIXELS = 200_000
"""Pictures with at most this many pixels go into a page as PNG, larger ones as JPEG."""
EXAMPLE_NAME = "index.html"
"""A good name for a page."""

CONTENT_POLICY = (
    "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)
"""Keeps the page to what it carries, whatever is written into it."""

BASE_STYLE = """
:root {
  --paper: #faf9f6; --card: #ffffff; --ink: #1d1c1a; --soft: #6c6a65; --line: #e4e1da; --accent: #b4492b;
  --serif: "Iowan Old Style", "Palatino Linotype", Palatino, "Book Antiqua", Georgia, serif;
  --sans: system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif;
}
@media (prefers-color-scheme: dark) {
  :root {
    --paper: #131314; --card: #1c1c1e; --ink: #f0eeea; --soft: #9b9892; --line: #2f2f32; --accent: #ef8e68;
  }
}
* { box-sizing: border-box; margin: 0; }
html { scroll-behavior: smooth; -webkit-text-size-adjust: 100%; }
body {
  background: var(--paper); color: var(--ink); font: 1rem/1.5 var(--sans);
  max-width: 82rem; margin: 0 auto; padding: clamp(1.25rem, 4vw, 4rem) clamp(1rem, 4vw, 3.5rem) 4rem;
}
h1, h2 { font-family: var(--serif); font-weight: 500; line-height: 1.1; letter-spacing: -0.015em; text-wrap: balance; }
h1 { font-size: clamp(2.1rem, 6vw, 3.75rem); }
h2 { font-size: clamp(1.5rem, 3.4vw, 2.1rem); }
h3 { font-size: 0.8125rem; font-weight: 600; letter-spacing: 0.04em; color: var(--accent); margin-bottom: 0.75rem; }
h4 { font-size: 0.8125rem; font-weight: 500; color: var(--soft); margin-bottom: 0.5rem; }
.top { margin-bottom: clamp(2rem, 5vw, 3.5rem); }
nav { display: flex; flex-wrap: wrap; gap: 0.5rem 1.5rem; margin-top: 1rem; }
a { color: var(--ink); text-decoration-color: var(--accent); text-underline-offset: 0.25em; }
"""
"""Colours, type and the room around."""


def html_page(title: str, style: str, body: str) -> str:
    """A whole page.

    Args:
        title: plain text.
        style: rules beside `BASE_STYLE`.
        body: HTML.
    """
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{CONTENT_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n<link rel="icon" href="data:,">\n'
        f"<title>{escape(title)}</title>\n<style>{BASE_STYLE}{style}</style>\n</head>\n<body>\n"
        f"{body}\n</body>\n</html>\n"
    )


def picture_page(title: str, contents: str, sections: str, style: str = "", script: str = "") -> str:
    """A whole page of sections with pictures and tables.

    Args:
        title: its heading, plain text.
        contents: HTML below the heading.
        sections: HTML of its body.
        style: rules beside those of pictures and tables.
        script: what it does.
    """
    body = f'<header class="top"><h1>{escape(title)}</h1>{contents}</header>\n<main>\n{sections}</main>' + (
        f"\n<script>{script}</script>" if script else ""
    )
    shared = (files("sparsestyle_ns.utils") / "page.css").read_text(encoding="utf-8")
    return html_page(title, shared + style, body)


def image(pixels: Pixels, alternative: str, name: str = "") -> str:
    """A picture as HTML, of a class `name` if there is one; the alternative text is plain."""
    height, width = pixels.shape[:2]
    names = f' class="{name}"' if name else ""
    return f'<img{names} src="{data_uri(pixels)}" width="{width}" height="{height}" alt="{escape(alternative)}">'


def figure(pixels: Pixels, caption: str, alternative: Optional[str] = None) -> str:
    """A picture with its caption, as HTML; both texts are plain."""
    return f"<figure>{image(pixels, alternative or caption)}<figcaption>{escape(caption)}</figcaption></figure>"


def data_uri(pixels: Pixels) -> str:
    """A picture as a data URI: PNG, or JPEG where PNG would be heavy."""
    lossless = pixels.shape[0] * pixels.shape[1] <= LOSSLESS_PIXELS
    buffer = io.BytesIO()
    if lossless:
        Image.fromarray(pixels).save(buffer, "PNG", optimize=True)
    else:
        Image.fromarray(pixels).save(buffer, "JPEG", quality=90)
    return f"data:image/{'png' if lossless else 'jpeg'};base64,{base64.b64encode(buffer.getvalue()).decode()}"


def table(head: Sequence[str], rows: Sequence[Sequence[str]], cited: Collection[str] = ()) -> str:
    """A table of plain texts as HTML; rows whose first cell is in `cited` are marked as others' figures."""
    heads = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in head)
    body = ""
    for row in rows:
        mark = " class=cited" if row[0] in cited else ""
        body += f"<tr{mark}>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>"
    return f'<div class="scroll"><table><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div>'


def prepare_page(output_path: Path) -> None:
    """Makes the folder that a page is to be written to.

    Raises:
        InputError: it can't be made or written to, or the page's name is that of a folder.
    """
    prepare_output(output_path, "The page", EXAMPLE_NAME)


def write_page(page: str, output_path: Path) -> Path:
    """Writes a page; the file appears under its name only when it is whole.

    Args:
        page: its HTML.
        output_path: the file; folders on the way to it are made.

    Returns:
        The file's absolute path.

    Raises:
        InputError: it can't be written there.
    """
    return write_output(output_path, page.encode(), "The page", EXAMPLE_NAME)
