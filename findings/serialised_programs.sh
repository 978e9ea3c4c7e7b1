#!/usr/bin/env bash
# jax: programs by `jax.experimental.serialize_executable` that load, and then fail as they run.
#
# Versions: jax 0.10.2, jaxlib 0.10.2, Python 3.11, a CPU. Seen on 2026-11-30:
#   A program that JAX found in its folder of compiled programs is serialised without a word and
#   loads; its call ends with "NOT_FOUND: Function ... not found". Compiled anew it is whole.
#   A program that calls LAPACK (a Cholesky factor) loads in a fresh process and ends it with SIGSEGV
#   when called; after any such function was lowered there, it runs.
# The guess that was wrong: what can be serialised and loaded can be called.
# It fails if any of this changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "jax==0.10.2" "jaxlib==0.10.2"
cat > "$folder/write.py" <<'PY'
import pickle
import sys

import jax
import jax.numpy as jnp
from jax.experimental.serialize_executable import serialize

function = {"plain": lambda x: jnp.cumsum(jnp.sin(x) @ x), "lapack": jnp.linalg.cholesky}[sys.argv[1]]
with open(sys.argv[2], "wb") as file:
    pickle.dump(serialize(jax.jit(function).lower(jnp.eye(3)).compile()), file)
PY
cat > "$folder/call.py" <<'PY'
import pickle
import sys

import jax
import jax.numpy as jnp
from jax.experimental.serialize_executable import deserialize_and_load

if "lowered" in sys.argv:
    jax.jit(jnp.linalg.cholesky).lower(jnp.eye(3))
with open(sys.argv[1], "rb") as file:
    run = deserialize_and_load(*pickle.load(file))
print(run(jnp.eye(3)))
PY
python="$folder/venv/bin/python"
export JAX_PLATFORMS=cpu JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0
export JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES=-1 JAX_COMPILATION_CACHE_DIR="$folder/cache"
"$python" "$folder/write.py" plain "$folder/compiled"
"$python" "$folder/write.py" plain "$folder/found"
"$python" "$folder/call.py" "$folder/compiled"
if "$python" "$folder/call.py" "$folder/found" 2> "$folder/error"; then exit 1; fi
grep "NOT_FOUND: Function .* not found" "$folder/error"
"$python" "$folder/write.py" lapack "$folder/lapack"
"$python" "$folder/call.py" "$folder/lapack" lowered
status=0
"$python" "$folder/call.py" "$folder/lapack" || status=$?
test "$status" = 139
