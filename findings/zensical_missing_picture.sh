#!/usr/bin/env bash
# zensical: a strict build tells a link to a page or an anchor that is not there, and no picture.
#
# Versions: zensical 0.0.73, Python 3.11. Seen on 2026-11-30:
#   A page with a link to a missing page, one to a missing anchor and a picture whose file is missing:
#   `build --strict` names two issues and ends with exit code 1. With the picture alone it says
#   "No issues found", ends with 0, and the site shows a broken picture.
# The guess that was wrong: a strict build fails over whatever a page names and does not have.
# It fails if any of this changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "zensical==0.0.73"
cd "$folder"
mkdir docs
printf '[project]\nsite_name = "one page"\n' > zensical.toml
printf '# Page\n\n## Here\n\n[page](none.md) [anchor](#nowhere)\n\n![picture](none.png)\n' > docs/index.md
! venv/bin/zensical build --strict > said 2>&1
grep -o '. issues found' said
[ "$(grep -o '. issues found' said)" = "2 issues found" ]
printf '# Page\n\n![picture](none.png)\n' > docs/index.md
venv/bin/zensical build --strict > said 2>&1
grep -o 'No issues found' said
grep -o '<img [^>]*none.png[^>]*>' site/index.html
[ ! -e site/none.png ]
