"""The pieces of a self-contained HTML page: no script, nothing loaded, every text escaped."""

import base64
import html
from collections.abc import Iterable, Sequence
from pathlib import Path

Cell = str | tuple[str, str]  # text, or text and a CSS class

_STYLE = """
:root { color-scheme: light dark; --ink: #222; --faint: #6b6b6b; --rule: #ddd; --ground: #fff; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e6e6; --faint: #a0a0a0; --rule: #3a3a3a; --ground: #17191c; }
}
body { font: 15px/1.55 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: var(--ink);
  background: var(--ground); max-width: 860px; margin: 40px auto 80px; padding: 0 20px; }
h1 { font-size: 25px; line-height: 1.25; margin: 0 0 4px; }
h2 { font-size: 18px; margin: 44px 0 8px; }
.wide { overflow-x: auto; margin: 12px 0 18px; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { padding: 5px 0 5px 18px; text-align: right; border-bottom: 1px solid var(--rule);
  vertical-align: top; white-space: pre; line-height: 1.4; }
th { font-weight: 600; color: var(--faint); vertical-align: bottom; white-space: pre-line; }
.words td { text-align: left; white-space: pre-wrap; overflow-wrap: anywhere; }
.words th { text-align: left; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
.note, figcaption { font-size: 13px; color: var(--faint); }
.strong { font-weight: 700; }
.missed { color: #d0401a; font-weight: 700; }
.inactive { color: var(--faint); }
.masked { color: #009e73; font-weight: 700; }
figure { margin: 26px 0; }
img { display: block; max-width: 100%; height: auto; background: #fff; box-sizing: border-box; }
@media (prefers-color-scheme: dark) { img { padding: 8px; border-radius: 4px; } }
summary { cursor: pointer; margin: 16px 0 8px; }
"""


def paragraph(sentences: Iterable[str], kind: str = "") -> str:
    """Sentences as a paragraph of a CSS class."""
    return f'<p class="{kind}">{html.escape(" ".join(sentences))}</p>'


def heading(text: str) -> str:
    """A section's heading."""
    return f"<h2>{html.escape(text)}</h2>"


def table(
    head: Sequence[str], rows: Iterable[Sequence[Cell]], note: str = "", kind: str = ""
) -> str:
    """A table with a note under it.

    Args:
      head: the columns' titles.
      rows: its cells; a line break in one is kept.
      note: under the table.
      kind: "words" aligns all columns left; else the first one left, those of numbers right.
    """
    lines = [f"<tr>{''.join(f'<th>{html.escape(text)}</th>' for text in head)}</tr>"]
    for row in rows:
        cells = [cell if isinstance(cell, tuple) else (cell, "") for cell in row]
        lines.append(f"<tr>{''.join(_cell(text, style) for text, style in cells)}</tr>")
    below = paragraph([note], "note") if note else ""
    return f'<div class="wide"><table class="{kind}">{"".join(lines)}</table></div>{below}'


def _cell(text: str, style: str) -> str:
    return f'<td class="{html.escape(style)}">{html.escape(text)}</td>'


def image(file: Path, caption: str) -> str:
    """A picture file as a data URI, with its caption."""
    data = base64.b64encode(file.read_bytes()).decode("ascii")
    kind, text = file.suffix.removeprefix("."), html.escape(caption)
    source = f'<img src="data:image/{kind};base64,{data}" alt="{text}">'
    return f"<figure>{source}<figcaption>{text}</figcaption></figure>"


def folded(title: str, body: str) -> str:
    """A part of the page that a click unfolds."""
    return f"<details><summary>{html.escape(title)}</summary>{body}</details>"


def write(file: Path, title: str, body: Iterable[str]) -> None:
    """Writes the page; `title` is text, `body` HTML from this module's functions."""
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{_STYLE}</style>'
    view = '<meta name="viewport" content="width=device-width, initial-scale=1">'
    content = "\n".join([f"<h1>{html.escape(title)}</h1>", *body])
    page = f'<html lang="en"><head>{head}{view}</head>\n<body>{content}</body></html>'
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"<!DOCTYPE html>\n{page}\n", encoding="utf-8")
