#!/usr/bin/env bash
# Builds the tests of all that reads or writes files with address and undefined behaviour sanitizers, in a catkin build
# folder of their own, and runs them. The exit status is 0 when all passed and no sanitizer had anything to say.
#
#   scripts/sanitize_readers.sh            all of them
#   scripts/sanitize_readers.sh TEST...    some, as test_bag_damage
#
# IMU_POSE_CALIB_DAMAGED_BAGS=N          copies of each kind of damaged bag, more than the 40 of the ordinary tests
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

READER_TESTS=(
  test_bag_damage test_bag_reader test_bag_topics test_cdr test_conversions test_imu_yaml test_mocap_csv test_point_cloud test_printable
  test_result_yaml test_ros2_damage test_ros_options test_text_reader test_text_table test_tf_chain
)
READERS_BUILD=$WORKSPACE/readers_sanitized
REPORTS=$LOG_DIR/readers_sanitized

# In the workspace, so that the core can come from the compiler's cache.
build_readers_sanitized() {
  local arguments
  read -ra arguments <<<"${IMU_POSE_CALIB_CMAKE_ARGS:-}"
  cmake -S "$WORKSPACE/src" -B "$READERS_BUILD" -DCATKIN_DEVEL_PREFIX="$READERS_BUILD/devel" \
    -DCMAKE_BUILD_TYPE=Release -DIMU_POSE_CALIB_SANITIZE=ON \
    -DPYTHON_EXECUTABLE=/usr/bin/python3 -DPython3_EXECUTABLE=/usr/bin/python3 "${arguments[@]}"
  cmake --build "$READERS_BUILD" --parallel "$(parallel_jobs)" --target "$@"
}

run_readers_sanitized() {
  local test failed=0
  rm -rf "$REPORTS"
  mkdir -p "$REPORTS"
  export ASAN_OPTIONS="log_path='$REPORTS/report'"
  export UBSAN_OPTIONS="log_path='$REPORTS/report':halt_on_error=1:print_stacktrace=1"
  for test in "$@"; do
    "$READERS_BUILD/devel/lib/imu_pose_calib/$test" || failed=1
  done
  cat "$REPORTS"/* 2>/dev/null && failed=1
  return "$failed"
}

main() {
  (($# > 0)) || set -- "${READER_TESTS[@]}"
  install_packages
  load_ros
  create_workspace
  step "build the readers with sanitizers" readers_sanitized_build build_readers_sanitized "$@"
  step "run their tests" readers_sanitized_tests run_readers_sanitized "$@"
}

main "$@"
