"""report.html: well-formed, by itself, escaped, and all that report.md says."""

import csv
import html.parser
import re
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from run_cli import GOOD, run

from jaxtrachea.files.html import ROWS, page
from jaxtrachea.files.pictures import save_each, with_ending

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


def test_a_verdict_has_its_colour_and_files_beside_are_links():
    text = "# T\n\n⚠ **13 of 14.**\n\nAll: `a b.csv`, `none.csv`.\n\n## Of A & B\n\n## Of A & B\n"
    made = page(text, {}, {}, files={"a b.csv", "x.csv"})
    assert '<p class="fair">⚠ <strong>13 of 14.</strong></p>' in made
    assert '<a href="a b.csv"><code>a b.csv</code></a>, <code>none.csv</code>' in made
    assert Reader(made).links[:3] == ["a b.csv", "#of-a-b", "#of-a-b-"]
    assert made.index("<nav>") < made.index('<h2 id="of-a-b">') < made.index('<h2 id="of-a-b-">')


def test_the_ending_of_a_picture_says_what_it_holds(tmp_path):
    drawings = {"a.png": Figure, "b.svg": Figure}
    save_each(tmp_path, drawings)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert "<svg" in (tmp_path / "b.svg").read_text()


def test_pictures_may_be_svg():
    text = with_ending("# T\n\n![a.png](fit.png)\n\nsee (fit.png)\n", "svg")
    assert text == "# T\n\n![a.png](fit.svg)\n\nsee (fit.png)\n"
    made = page(text, {"fit.svg": b"<svg/>"}, {})
    assert "data:image/svg+xml;base64,PHN2Zy8+" in made


def test_long_tables_end_with_a_note():
    rows = "\n".join(f"| {i} |" for i in range(ROWS + 5))
    made = page(f"# T\n\n| n |\n| --- |\n{rows}\n", {}, {})
    assert len(Reader(made).tables[0]) == ROWS + 1
    assert f"The first {ROWS} rows, and 5 more" in made


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
    assert "Influence of curves" in headings
    assert read.headings[:2] == [headings[0], "Pictures"]
    assert set(read.headings) == {*headings, "Provenance", "Explorer"}
    assert len(read.tables) == text.count("\n| --- ") + 2
    assert sum(link.startswith("data:image/png") for link in read.links) == text.count("![") == 2
    beside = {path.name for path in Path("out").iterdir()}
    assert {"influence.csv", "summary.csv", "results.h5"} <= beside & set(read.links)
    inside = [link.removeprefix("#") for link in read.links if link.startswith("#")]
    assert len(inside) == len(set(read.headings)) - 1
    assert all(f'id="{name}"' in made for name in inside)
    assert not re.search(r"https?:(?!//www.w3.org/2000/svg)|<link|@import|url\(", made)
    assert made.count("<script") == made.count("</script>") == 2  # of the explorer
    assert any("<script>" in row for table in read.tables for row in table)
