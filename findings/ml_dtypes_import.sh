#!/usr/bin/env bash
# ml_dtypes 0.7.0, which `pip install jax` brings: its import takes longer than the rest of JAX's.
#
# Versions: ml_dtypes 0.6.0 and 0.7.0, numpy 2.4.6, jax 0.10.2, Python 3.11, Linux x86-64. Seen on
# 2026-12-01, seconds of `import ml_dtypes` after numpy: 0.004 (0.6.0; 0.5.1 and 0.5.4 the same) and
# 0.60; `import jax` 0.8 and 1.4. By perf it is numpy's PyUFunc_AddLoop, which compares each new loop
# of a ufunc with all that it has: 0.7.0 registers the mixed pairs of its types too.
# The guess that was wrong: what JAX needs for its small dtypes costs a start nothing, and a start
# that got slower by half a second did so by our own modules.
# It fails if the newer version no longer takes 20 times as long.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
python="$folder/venv/bin/python"
"$folder/venv/bin/pip" install -q "numpy==2.4.6" "jax==0.10.2" "jaxlib==0.10.2"
cat > "$folder/seconds.py" <<'PY'
import subprocess
import sys

code = """
import importlib, time, numpy
begin = time.perf_counter()
importlib.import_module(%r)
print(time.perf_counter() - begin)
"""
runs = [subprocess.check_output([sys.executable, "-c", code % sys.argv[1]]) for _ in range(5)]
print(f"{min(map(float, runs)):.4f}")
PY
for version in 0.6.0 0.7.0; do
  "$folder/venv/bin/pip" install -q --no-deps "ml_dtypes==$version"
  seconds=$("$python" "$folder/seconds.py" ml_dtypes)
  echo "ml_dtypes $version: $seconds s; import jax: $("$python" "$folder/seconds.py" jax) s"
  echo "$seconds" > "$folder/$version"
done
awk -v old="$(cat "$folder/0.6.0")" -v new="$(cat "$folder/0.7.0")" 'BEGIN { exit !(new > 20 * old) }'
