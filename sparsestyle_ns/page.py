"""What HTML pages of this package have in common: one file that needs nothing else, light or dark."""

from html import escape

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
