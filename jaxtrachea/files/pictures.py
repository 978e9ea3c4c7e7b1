"""What users named, as plain text in pictures; pictures saved so that a bad one costs only itself.

matplotlib reads text between two `$` as mathematics, and hides labels that start with `_`.
"""

import io
import re
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

#: Characters of a name in a picture; beyond it, an ellipsis.
LONGEST = 48
#: PNG in half of the time, a twelfth larger.
QUICKLY = {"compress_level": 1}
#: What all figures share.
STYLE: dict[Any, object] = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "font.size": 9,
    "legend.frameon": False,
    "legend.fontsize": 7,
    "figure.dpi": 130,
    "text.usetex": False,
}


def plain(name: str, longest: int = LONGEST) -> str:
    """A name as matplotlib shall show it: one line, no mathematics, not hidden, not endless."""
    words = " ".join("".join(c if c.isprintable() else " " for c in name).split())
    short = words if len(words) <= longest else f"{words[: longest - 1]}…"
    # matplotlib draws "\$" as "$", and what holds no other "$" is no mathematics.
    safe = short.replace("$", r"\$")
    return f" {safe}" if safe.startswith("_") else safe


def save_each(
    folder: Path, drawings: Mapping[str, Callable[[], Any]]
) -> tuple[list[Path], dict[str, str]]:
    """Draw and write every picture; one that fails is left out, whatever it failed of.

    `Figure.savefig` goes through a figure twice, the first time without drawing it.

    Args:
        drawings: file name, with its ending (`png` or `svg`), to what returns the figure.

    Returns:
        The files written, and for those that are not, why.

    Raises:
        OSError: a file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    paths, lost = [], {}
    for name, draw in drawings.items():
        memory = io.BytesIO()
        try:
            with warnings.catch_warnings():
                # A letter that the font has not got is drawn as a box.
                warnings.filterwarnings("ignore", message=r"(?s).*Glyph .* missing")
                if name.endswith(".svg"):
                    from matplotlib.backends.backend_svg import FigureCanvasSVG

                    FigureCanvasSVG(draw()).print_svg(memory)
                else:
                    FigureCanvasAgg(draw()).print_png(memory, pil_kwargs=QUICKLY)
        except Exception as error:  # a picture is worth less than the numbers
            lost[name] = " ".join(f"{type(error).__name__}: {error}".split())[:300]
            continue
        paths.append(folder / name)
        paths[-1].write_bytes(memory.getvalue())
    return paths, lost


def sentence(name: str, reason: str) -> str:
    """What stands in the place of a picture that could not be drawn."""
    return f"the picture {name} could not be drawn ({reason}); all numbers are written"


def without_lost(text: str, lost: Mapping[str, str]) -> str:
    """The text of a report with words where pictures would be that could not be drawn."""
    for name, reason in lost.items():
        words = f"**No {name}**: {sentence(name, reason)}."
        text = re.sub(
            rf"^!\[[^\n]*\]\({re.escape(name)}\)$", lambda _, w=words: w, text, flags=re.M
        )
    return text


def with_ending(text: str, ending: str) -> str:
    """The text of a report whose pictures have another ending than png."""
    return re.sub(r"^(!\[[^\n]*\]\(\w+)\.png\)$", rf"\1.{ending})", text, flags=re.M)


def grid(count: int, height: float = 2.7):
    """A figure of at least `count` axes in up to three columns, the others hidden; and its axes."""
    from matplotlib.figure import Figure

    columns = min(3, count)
    rows = -(-count // columns)
    size = (max(4.6, 3.6 * columns), height * rows + 0.6)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat[count:]:
        axis.set_visible(False)
    return figure, axes.flat


def of_all(shown: int, total: int, what: str) -> str:
    """In a title, how much of all is drawn; "" for all."""
    return "" if shown >= total else f", {shown} {what} of {total}"
