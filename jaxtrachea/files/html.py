"""The written report as one HTML file: no network, pictures inside.

It is rendered from the text of report.md by markdown-it-py, with those rules alone that a report
uses: headings, paragraphs, lists, tables, pictures, `code` and **bold**. All else is text, and
escaped, so that no name of a specimen becomes markup.
"""

import base64
import html
import json
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from markdown_it import MarkdownIt
from markdown_it.token import Token

#: Rows of a table; beyond it a note says where the rest is.
ROWS = 200

#: Tokens of the rows of a table.
_OF_ROWS = ("inline", "tr_open", "tr_close", "td_open", "td_close")
#: Paragraphs that begin with such a mark are a verdict, in a colour that nobody takes for another
#: (Okabe and Ito 2008, Color universal design): blue, orange, vermilion.
MARKS = {"✓ ": "good", "⚠ ": "fair", "✗ ": "poor"}

_STYLE = """
:root { color-scheme: light dark; --line: #8885; --soft: #8881; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; }
h1, h2 { line-height: 1.2; margin: 2rem 0 .6rem; }
nav { columns: 14rem; font-size: 13px; border-block: 1px solid var(--line); padding: .6rem 0; }
nav a { display: block; }
.good, .fair, .poor { border-left: .4rem solid; padding: .3rem .8rem; background: var(--soft); }
.good { border-color: #0072b2; }
.fair { border-color: #e69f00; }
.poor { border-color: #d55e00; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { border-bottom: 1px solid var(--line); padding: .25rem .7rem .25rem 0; text-align: left; }
td { vertical-align: top; }
tbody tr:hover { background: var(--soft); }
code { background: var(--soft); padding: 0 .2rem; overflow-wrap: anywhere; }
figure { margin: 1.5rem 0; }
img { max-width: 100%; height: auto; background: #fff; border-radius: 4px; }
.note, figcaption { font-size: 13px; opacity: .75; }
@media (max-width: 40rem) {
  body { margin: .5rem auto; padding: 0 .6rem; }
  h1 { font-size: 1.4rem; }
  figure { overflow-x: auto; }
  img { max-width: none; width: 44rem; }
}
@media print {
  body { max-width: none; margin: 0; font-size: 10pt; }
  nav, .screen { display: none; }
  .wide { overflow: visible; }
  table { font-size: 8pt; }
  figure, tr, .good, .fair, .poor { break-inside: avoid; }
  h2 { break-after: avoid; }
}
"""


def page(
    text: str,
    pictures: Mapping[str, bytes],
    provenance: Mapping[str, object],
    *,
    files: Collection[str] = (),
    explorer: str = "",
) -> str:
    """The report as a web page.

    Args:
        text: of report.md.
        pictures: PNG or SVG by file name, of those that `text` shows.
        provenance: shown at the end.
        files: names of the files beside it: `name` in the text is a link to one of them.
        explorer: HTML before the section of the estimates.

    Raises:
        KeyError: `text` shows a picture that is not given.
    """
    title = text.strip().partition("\n")[0].removeprefix("# ")
    rows = [
        [name, value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)]
        for name, value in provenance.items()
    ]
    body = _rendered(text, pictures, frozenset(files), explorer=bool(explorer))
    before, heading, after = body.partition('<h2 id="estimates">')
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{html.escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<main>",
            f"{before}{explorer}{heading}{after}",
            '<h2 id="provenance">Provenance</h2>',
            _plain_table(["what", "value"], rows),
            "</main>\n</body>\n</html>\n",
        ]
    )


def _rendered(
    text: str, pictures: Mapping[str, bytes], files: frozenset[str], *, explorer: bool
) -> str:
    """The text as HTML; pictures inside, long tables cut with a note, contents where it divides."""
    rules = ["heading", "list", "table", "backticks", "emphasis", "image"]
    markdown = MarkdownIt("zero").enable(rules)
    markdown.add_render_rule("image", _figure)
    markdown.add_render_rule("code_inline", _code)
    for name in ("em_open", "em_close", "strong_open", "strong_close"):
        markdown.add_render_rule(name, _emphasis)
    tokens = _short_tables(markdown.parse(text))
    headings = {"explorer": "Explorer"} if explorer else {}
    first = None
    for before, inline, after in zip(tokens, tokens[1:], tokens[2:], strict=False):
        # A figure is a block of its own, not part of a paragraph.
        if [child.type for child in inline.children or ()] == ["image"]:
            before.hidden = after.hidden = True
        if before.type == "paragraph_open" and inline.content[:2] in MARKS:
            before.attrSet("class", MARKS[inline.content[:2]])
        if before.type == "heading_open" and before.tag == "h2":
            first = first or before
            name = re.sub(r"\W+", "-", inline.content.lower())
            while name in (*headings, "provenance"):
                name += "-"
            headings[name] = inline.content
            before.attrSet("id", name)
    if first is not None:
        headings["provenance"] = "Provenance"
        links = [f'<a href="#{n}">{html.escape(words)}</a>' for n, words in headings.items()]
        tokens.insert(tokens.index(first), _markup(f"<nav>{''.join(links)}</nav>\n"))
    env = {"pictures": pictures, "files": files}
    return markdown.renderer.render(tokens, markdown.options, env)


def _short_tables(tokens: Sequence[Token]) -> list[Token]:
    """Tables that scroll by themselves, of at most `ROWS` rows and a note where the rest is."""
    kept: list[Token] = []
    rows = 0
    for token in tokens:
        if token.type == "table_open":
            kept.append(_markup('<div class="wide">'))
            rows = -1  # the head
        if token.type == "tr_open":
            rows += 1
        if rows <= ROWS or token.type not in _OF_ROWS:
            kept.append(token)
        if token.type == "table_close":
            kept.append(_markup(f"</div>{_note(rows)}\n"))
    return kept


def _markup(text: str) -> Token:
    """HTML of our own between that of the text."""
    return Token("html_block", "", 0, content=text)


def _note(rows: int) -> str:
    """Where the rows are that a table does not show."""
    if rows <= ROWS:
        return ""
    return (
        f'\n<p class="note">The first {ROWS} rows, and {rows - ROWS} more: the CSV files beside '
        "this page and report.md hold all.</p>"
    )


def _figure(renderer, tokens: Sequence[Token], i: int, options, env: Mapping[str, Any]) -> str:
    """A picture inside the page."""
    caption = html.escape(tokens[i].content)
    name = str(tokens[i].attrs["src"])
    data = base64.b64encode(env["pictures"][name]).decode()
    kind = "svg+xml" if name.endswith(".svg") else "png"
    image = f'<img alt="{caption}" src="data:image/{kind};base64,{data}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def _code(renderer, tokens: Sequence[Token], i: int, options, env: Mapping[str, Any]) -> str:
    """The name of a file beside the page is a link to it."""
    text = html.escape(tokens[i].content)
    code = f"<code>{text}</code>"
    return f'<a href="{text}">{code}</a>' if tokens[i].content in env["files"] else code


def _emphasis(renderer, tokens: Sequence[Token], i: int, options, env) -> str:
    """**Bold** alone is markup; stars and underscores of names stay what they are."""
    token = tokens[i]
    if token.markup != "**":
        return token.markup
    return f"<{'/' if token.nesting < 0 else ''}strong>"


def _plain_table(head: list[str], rows: list[list[str]]) -> str:
    """A table of text without any markup."""
    cells = [[html.escape(cell) for cell in row] for row in rows]
    body = "\n".join(f"<tr><td>{'</td><td>'.join(row)}</td></tr>" for row in cells)
    return (
        f'<div class="wide"><table>\n<thead><tr><th>{"</th><th>".join(head)}</th></tr></thead>\n'
        f"<tbody>\n{body}\n</tbody>\n</table></div>"
    )
