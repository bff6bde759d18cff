"""The pieces of a self-contained HTML page: no script, nothing loaded, every text escaped."""

import base64
import html
from collections.abc import Iterable, Sequence
from pathlib import Path

Cell = str | tuple[str, str]  # text, or text and a CSS class

_STYLE = Path(__file__).with_name("page.css")


def paragraph(sentences: Iterable[str], kind: str = "") -> str:
    """Sentences as a paragraph of a CSS class; no line begins with a per cent sign."""
    text = html.escape(" ".join(sentences)).replace(" %", "&nbsp;%")
    return f'<p class="{kind}">{text}</p>'


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


def images(files: Sequence[tuple[Path, str]]) -> list[str]:
    """Picture files with their captions, and a word on how to see them larger."""
    note = paragraph(["A tap or a click on a picture shows it in full size, and back."], "note")
    return [*([note] if files else []), *(_image(file, caption) for file, caption in files)]


def _image(file: Path, caption: str) -> str:
    data = base64.b64encode(file.read_bytes()).decode("ascii")
    kind, text = file.suffix.removeprefix("."), html.escape(caption)
    source = f'<img src="data:image/{kind};base64,{data}" alt="{text}">'
    opens = f"<details><summary>{source}</summary></details>"
    return f"<figure>{opens}<figcaption>{text}</figcaption></figure>"


def folded(title: str, body: str) -> str:
    """A part of the page that a click unfolds."""
    return f"<details><summary>{html.escape(title)}</summary>{body}</details>"


def write(file: Path, title: str, body: Iterable[str]) -> None:
    """Writes the page; `title` is text, `body` HTML from this module's functions."""
    style = _STYLE.read_text(encoding="utf-8")
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{style}</style>'
    view = '<meta name="viewport" content="width=device-width, initial-scale=1">'
    content = "\n".join([f"<h1>{html.escape(title)}</h1>", *body])
    page = f'<html lang="en"><head>{head}{view}</head>\n<body>{content}</body></html>'
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"<!DOCTYPE html>\n{page}\n", encoding="utf-8")
