#!/usr/bin/env bash
# afmformats: errors that `except Exception` does not catch, and exports that it cannot load.
#
# Versions: afmformats 0.18.7, numpy 2.4.6, Python 3.11. Seen on 2026-11-28:
#   MissingMetaDataError and AFMFileFormatError are BaseExceptions, as KeyboardInterrupt is: a broken
#   file ends a program that guards itself with `except Exception`.
#   A curve with metadata enum 1, exported to HDF5, is refused by the loader of the same version
#   (FileFormatNotSupportedError); enum 0, and both as tab, load.
# The guess that was wrong: errors of a library are Exceptions; what it exports it can load.
# It fails if any of this changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "afmformats==0.18.7" "numpy==2.4.6"
cat > "$folder/run.py" <<'PY'
import logging
import pathlib
import sys

import afmformats
import numpy as np
from afmformats.mod_force_distance import AFMForceDistance

logging.disable(logging.CRITICAL)
data = {
    "force": np.arange(6) * 1e-9,
    "height (measured)": np.linspace(5e-6, 4e-6, 6),
    "segment": np.array([0, 0, 0, 1, 1, 1], np.uint8),
}
found = {}
for enum in (0, 1):
    curve = AFMForceDistance(
        data,
        {"spring constant": 0.02, "enum": enum, "imaging mode": "force-distance",
         "path": pathlib.Path("x")},
    )
    for form in ("tab", "h5"):
        path = pathlib.Path(sys.argv[1]) / f"{enum}.{form}"
        curve.export_data(path, metadata=True, fmt=form)
        try:
            found[enum, form] = len(afmformats.load_data(path)[0])
        except Exception as error:
            found[enum, form] = "Exception"
        except BaseException as error:
            found[enum, form] = type(error).__name__
print(found)
assert found == {
    (0, "tab"): 6, (0, "h5"): 6, (1, "tab"): 6, (1, "h5"): "FileFormatNotSupportedError"
}
assert not issubclass(afmformats.errors.MissingMetaDataError, Exception)
PY
"$folder/venv/bin/python" "$folder/run.py" "$folder"
