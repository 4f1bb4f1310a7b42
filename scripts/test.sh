#!/usr/bin/env bash
# Builds and runs every gtest and rostest. The last line is "N passed, M failed"; the exit status is 0 when all passed.
#
#   scripts/test.sh            all tests
#   scripts/test.sh REGEXP     those whose name matches, as in `ctest -R`
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

# ctest over what `catkin_make run_tests` would run: it sees the exit status of every test, too. Those that look at the
# clock run alone. Its verdict is read from the results.
run_ctest() {
  cd "$WORKSPACE/build"
  rm -rf test_results Testing
  ctest --show-only=json-v1 "$@" >ctest.json
  ctest --output-on-failure --timeout 1200 -j"$(parallel_jobs)" "$@" || true
}

main() {
  setup
  step "build the tests" build_tests catkin_build tests
  load_workspace
  step "run the tests" run_tests run_ctest ${1:+-R "$1"}
  /usr/bin/python3 "$REPO/scripts/count_tests.py" "$WORKSPACE/build" "$LOG_DIR/run_tests.log"
}

main "$@"
