#!/usr/bin/env bash
# ruff with jaxtyping: a shape of two words is a syntax error (F722), with a star it may be a name.
#
# Versions: ruff 0.17.5, jaxtyping 0.3.11, numpy 2.4.6, Python 3.11. Seen on 2026-11-30:
#   With F722 ignored, as jaxtyping advises, Float[np.ndarray, "m n"], "*m n", "m ..." and " m" pass.
#   "m *more" does not: it parses as the product m * more, so that both are undefined names (F821).
#   jaxtyping takes all five. F821 ignored too would hide real undefined names.
# The guess that was wrong: where one shape with a star passes the linter, each does.
# It fails if any of this changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "ruff==0.17.5" "jaxtyping==0.3.11" "numpy==2.4.6"
cat > "$folder/shapes.py" <<'PY'
import numpy as np
from jaxtyping import Float


def f(
    a: Float[np.ndarray, "m n"], b: Float[np.ndarray, "*m n"], c: Float[np.ndarray, "m ..."],
    d: Float[np.ndarray, " m"],
):
    return a, b, c, d


def g(a: Float[np.ndarray, "m *more"]):
    return a


assert isinstance(np.zeros((2, 3, 4)), g.__annotations__["a"])
PY
"$folder/venv/bin/python" "$folder/shapes.py"
found=$("$folder/venv/bin/ruff" check --isolated --select F --ignore F722 --output-format concise \
  "$folder/shapes.py" | grep -o 'F[0-9]* .*' | grep -v '^Found' || true)
echo "$found"
[ "$found" = "F821 Undefined name \`m\`
F821 Undefined name \`more\`" ]
