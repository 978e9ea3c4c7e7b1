"""report.html: well-formed, by itself, escaped, and all that report.md says."""

import csv
import html.parser
import re
from pathlib import Path

import pytest
from run_cli import GOOD, run

from jaxtrachea.files.html import ROWS, page

PAGE = Path(__file__).parents[1] / "docs" / "results.md"
VOID = {"meta", "img"}


class Reader(html.parser.HTMLParser):
    """Tags in order, text of every cell and heading; every tag must be closed in its turn."""

    def __init__(self, text):  # noqa: D107
        super().__init__()
        self.open, self.tags, self.links, self.tables, self.headings = [], [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.tables[-1][-1].append("")
        if tag in ("h1", "h2"):
            self.headings.append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if {"td", "th"} & set(self.open):
            self.tables[-1][-1][-1] += data
        if {"h1", "h2"} & set(self.open):
            self.headings[-1] += data


def test_blocks_are_rendered_and_escaped():
    text = """# A & B

Some `code` & **bold** <i>text</i>.

| specimen | value |
| --- | --- |
| <script>alert(1)</script> | a\\|b |

- one
- two <b>

![data & fit](fit.png)
"""
    made = page(text, {"fit.png": b"\x89PNG"}, {"command": ["jaxtrachea", "<x>"]})
    read = Reader(made)
    assert read.tables[0] == [["specimen", "value"], ["<script>alert(1)</script>", "a|b"]]
    assert read.tables[1][1] == ["command", '["jaxtrachea", "<x>"]']
    assert "script" not in read.tags
    assert "<b>" not in made
    assert (
        "<p>Some <code>code</code> &amp; <strong>bold</strong> &lt;i&gt;text&lt;/i&gt;.</p>" in made
    )
    assert read.links == ["data:image/png;base64,iVBORw=="]
    assert read.headings == ["A & B", "Provenance"]
    assert read.tags.count("li") == 2


NAMES = ["_a_", "*a*", "__a__", "a*b*c", r"C:\_x\*y", "<b>", "[a](b)", "~~a~~", "&amp;", "1. a"]


@pytest.mark.parametrize("name", NAMES)
def test_names_are_no_markup(name):
    """What a specimen may be called is shown as it is, in a table and in a line of text."""
    read = Reader(page(f"# T\n\n| n |\n| --- |\n| {name} |\n\nOf {name} alone.\n", {}, {}))
    assert read.tables[0] == [["n"], [name]]
    assert not {"em", "strong", "a", "b", "s"} & set(read.tags)


def test_long_tables_end_with_a_note():
    rows = "\n".join(f"| {i} |" for i in range(ROWS + 5))
    made = page(f"# T\n\n| n |\n| --- |\n{rows}\n", {}, {})
    assert len(Reader(made).tables[0]) == ROWS + 1
    assert f"The first {ROWS} of {ROWS + 5} rows" in made


def test_a_picture_that_is_not_there_is_an_error():
    with pytest.raises(KeyError, match="fit.png"):
        page("# T\n\n![fit](fit.png)\n", {}, {})


def columns(heading):
    body = re.split(r"^## ", PAGE.read_text().partition(heading)[2], maxsplit=1, flags=re.M)[0]
    return re.findall(r"^\| `([\w/ ]+)` \|", body, re.M)


@pytest.mark.slow
@pytest.mark.compiling
def test_command_writes_what_its_page_says(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    data = GOOD + GOOD.partition("\n")[2].replace("T01,1,", "T01,2,")
    Path("good.csv").write_text(data.replace("T01", "<script>"))
    Path("spec.toml").write_text('[data]\nfiles = "good.csv"\n[model]\ncoupling = "total"\n')
    code, _, _ = run(monkeypatch, capsys, "fit", "spec.toml", "--influence", "--out", "out")
    assert code == 0
    for name, rows in (("influence", 8), ("influence_curves", 2)):
        with Path(f"out/{name}.csv").open(newline="") as stream:
            table = list(csv.DictReader(stream))
        head = columns(f"## {name}.csv")
        assert list(table[0])[: len(head)] == head
        assert len(table) == rows
    text, made = (Path(f"out/report.{kind}").read_text() for kind in ("md", "html"))
    read = Reader(made)
    headings = re.findall(r"^##? (.+)", text, re.M)
    assert "Influence" in headings
    assert read.headings == [*headings, "Provenance"]
    assert len(read.tables) == text.count("\n| --- ") + 1
    assert sum(link.startswith("data:image/png") for link in read.links) == text.count("![") == 3
    assert len(read.links) == 3
    assert not re.search(r"https?:|<script|<link|@import|url\(", made)
    assert any("<script>" in row for table in read.tables for row in table)
