"""The written report as one HTML file: no network, no script, pictures inside.

It is made from the text of report.md, which has headings, paragraphs, lists, tables and pictures,
each between blank lines, and within a line `code` and **bold**. All else is text, and escaped.
"""

import base64
import html
import json
import re
from collections.abc import Mapping

#: Rows of a table; beyond it a note says where the rest is.
ROWS = 200

_STYLE = """
:root { color-scheme: light dark; --line: #8885; --soft: #8881; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1, h2 { line-height: 1.2; margin: 2rem 0 .6rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { border-bottom: 1px solid var(--line); padding: .25rem .7rem .25rem 0; text-align: left; }
td { vertical-align: top; }
tbody tr:hover { background: var(--soft); }
code { background: var(--soft); padding: 0 .2rem; }
figure { margin: 1.5rem 0; }
img { max-width: 100%; background: #fff; border-radius: 4px; }
.note { font-size: 13px; opacity: .75; }
"""


def page(text: str, pictures: Mapping[str, bytes], provenance: Mapping[str, object]) -> str:
    """The report as a web page.

    Args:
        text: of report.md.
        pictures: PNG by file name, of those that `text` shows.
        provenance: shown at the end.

    Raises:
        KeyError: `text` shows a picture that is not given.
    """
    blocks = [block for block in text.strip().split("\n\n") if block.strip()]
    title = blocks[0].removeprefix("# ")
    rows = [
        [name, value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)]
        for name, value in provenance.items()
    ]
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{html.escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>",
            *(_block(block, pictures) for block in blocks),
            "<h2>Provenance</h2>",
            _table(["what", "value"], rows),
            "</body>\n</html>\n",
        ]
    )


def _block(block: str, pictures: Mapping[str, bytes]) -> str:
    """One block of the text."""
    if heading := re.fullmatch(r"(#{1,6}) (.*)", block):
        level = len(heading[1])
        return f"<h{level}>{_inline(heading[2])}</h{level}>"
    if picture := re.fullmatch(r"!\[(.*)\]\(([\w.-]+)\)", block):
        return _figure(picture[1], pictures[picture[2]])
    lines = block.split("\n")
    if all(line.startswith("- ") for line in lines):
        items = "\n".join(f"<li>{_inline(line[2:])}</li>" for line in lines)
        return f"<ul>\n{items}\n</ul>"
    if len(lines) > 1 and lines[0].startswith("| ") and lines[1].startswith("| ---"):
        head, _, *rows = map(_cells, lines)
        return _table(head, rows)
    return f"<p>{_inline(block)}</p>"


def _cells(line: str) -> list[str]:
    """Cells of a line of a table, bars in them no longer escaped."""
    parts = re.split(r"(?<!\\)\|", line.strip())[1:-1]
    return [part.strip().replace("\\|", "|") for part in parts]


def _table(head: list[str], rows: list[list[str]]) -> str:
    """A table of at most `ROWS` rows."""
    line = lambda tag, cells: "".join(f"<{tag}>{_inline(cell)}</{tag}>" for cell in cells)  # noqa: E731
    body = "\n".join(f"<tr>{line('td', row)}</tr>" for row in rows[:ROWS])
    note = ""
    if len(rows) > ROWS:
        note = f'\n<p class="note">The first {ROWS} of {len(rows)} rows; the CSV files beside this '
        note += "page and report.md hold all.</p>"
    return (
        f'<div class="wide"><table>\n<thead><tr>{line("th", head)}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody>\n</table></div>{note}"
    )


def _figure(caption: str, png: bytes) -> str:
    """A picture inside the page."""
    data, text = base64.b64encode(png).decode(), html.escape(caption)
    image = f'<img alt="{text}" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{text}</figcaption></figure>"


def _inline(text: str) -> str:
    """Text with `code` and **bold**, escaped first."""
    safe = html.escape(text)
    safe = re.sub(r"`([^`]+)`", r"<code>\1</code>", safe)
    return re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", safe)
