"""Writes docs/evidence/hard_cases.md: python tests/reference/hard_cases_page.py, from the root."""

import datetime
import pathlib

import jax

from jaxtrachea.selfcheck.page import page
from jaxtrachea.selfcheck.table import DTYPES, read_cases, read_truth

DOCUMENT = pathlib.Path(__file__).parents[2] / "docs" / "evidence" / "hard_cases.md"

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    from jaxtrachea.selfcheck.run import run_table

    cases = read_cases()
    where = f"{jax.devices()[0]}, jax {jax.__version__}, {datetime.date.today()}"
    DOCUMENT.write_text(page(cases, list(run_table(cases, read_truth(), DTYPES)), where))
