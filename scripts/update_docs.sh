#!/usr/bin/env bash
# Runs every command that README.md and doc/ show, on a simulated recording, and renews the output that they show.
#
#   scripts/update_docs.sh            writes the documents
#   scripts/update_docs.sh --check    only says what differs; the exit status is 0 when nothing does
#   ... README.md doc/bags.md         these documents alone
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

setup
step "build" build catkin_build
load_workspace
exec /usr/bin/python3 "$REPO/scripts/update_docs.py" "$@"
