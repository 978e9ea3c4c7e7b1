#!/usr/bin/env bash
# pandas.read_csv: which number a decimal becomes, and what a column of names becomes.
#
# Versions: pandas 3.0.0 and 3.1.0, numpy 2.4.6, Python 3.11. Seen on 2026-11-28:
#   3.0.0: 45071 of 149964 decimals differ from float() in the last bits, by the default precision.
#          dtype="category" keeps the names 01 and 02.
#   3.1.0: none differs; `float_precision` is deprecated.
#          dtype="category" makes the numbers 1 and 2 of them; dtype=object keeps them in both.
# The guess that was wrong: read_csv rounds correctly, as float() does, and a categorical column of
# text holds the text ("categories will always be parsed as strings", says the user guide).
# It fails if any of this changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
cat > "$folder/run.py" <<'PY'
import io
import sys

import numpy as np
import pandas as pd

rng = np.random.default_rng(7)
values = rng.integers(0, 2**63, 30000, dtype=np.uint64).view(np.float64)
values = values[np.isfinite(values)].tolist()
texts = [form.format(x) for x in values for form in ("{!r}", "{:.16e}", "{:.3e}", "{:.25g}")]
texts += [f"{x:.{k % 24}f}" for k, x in enumerate(rng.uniform(-99, 99, 30000))]
found = pd.read_csv(io.StringIO("\n".join(texts)), header=None)[0].to_numpy()
wrong = int(np.sum(found != np.array([*map(float, texts)])))
names = io.StringIO("01,a\n02,b\n")
categories = pd.read_csv(names, header=None, dtype="category")[0].cat.categories.tolist()
names.seek(0)
kept = pd.read_csv(names, header=None, dtype=object)[0].tolist()
print(f"pandas {pd.__version__}: {wrong} of {len(texts)} differ; {categories}, {kept}")
old = sys.argv[1] == "old"
expected = ["01", "02"] if old else [1, 2]
sys.exit((wrong > 0) != old or categories != expected or kept != ["01", "02"])
PY
for case in "3.0.0 old" "3.1.0 new"; do
  read -r version behaviour <<< "$case"
  "$folder/venv/bin/pip" install -q "pandas==$version" "numpy==2.4.6"
  "$folder/venv/bin/python" "$folder/run.py" "$behaviour"
done
