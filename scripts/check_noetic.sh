#!/usr/bin/env bash
# Builds the package and its tests against libraries in prefixes, such as those of Ubuntu 20.04, instead of the system's,
# and runs the tests. ROS is the system's. Warnings are errors.
#
#   scripts/check_noetic.sh [-R REGEXP] PREFIX...
#
# PREFIX      where one or more of Eigen, Ceres, yaml-cpp, googletest, CMake (bin/cmake) and gcc (bin/g++) are installed.
#             What is in none of them is the system's. CC and CXX choose another compiler.
# -R REGEXP   only the tests whose name matches, as in `ctest -R`; '^$' for none
#
# The versions used are printed. Any header of a library found in a prefix that was read from elsewhere is an error.
# The build is in .catkin_ws/noetic and is used again by the next run.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

WORKSPACE=$REPO/.catkin_ws/noetic
LOG_DIR=$WORKSPACE/log
LIBRARIES=(Eigen3 Ceres yaml-cpp GTest)

usage() {
  sed -n '2,/^set/ { /^set/d; s/^# \{0,1\}//; p }' "${BASH_SOURCE[0]}"
}

# use_prefixes PREFIX...: found first by CMake, by the shell and by the loader.
use_prefixes() {
  local prefix i
  for ((i = $#; i > 0; --i)); do
    prefix=${!i}
    export CMAKE_PREFIX_PATH=$prefix${CMAKE_PREFIX_PATH:+:$CMAKE_PREFIX_PATH}
    export LD_LIBRARY_PATH=$prefix/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}
    export PATH=$prefix/bin:$PATH
  done
}

# cached NAME: a variable of the configured build.
cached() {
  sed -n "s/^$1:[A-Z]*=//p" "$WORKSPACE/build/CMakeCache.txt"
}

print_versions() {
  local library folder version
  cmake --version | head -n 1
  "$(cached CMAKE_CXX_COMPILER)" --version | head -n 1
  for library in "${LIBRARIES[@]}"; do
    folder=$(cached "${library}_DIR")
    version=$(sed -nE 's/^ *set *\(PACKAGE_VERSION "?([0-9.]+)"?\).*/\1/ip' "$folder"/*[vV]ersion.cmake | head -n 1)
    echo "$library $version from $folder"
  done
}

# A library that is found in a prefix is read from nowhere else. -MD has left the names of all headers read.
check_headers() {
  local used header folder library i
  local headers=(Eigen/src/Core/util/Macros.h ceres/version.h yaml-cpp/yaml.h gtest/gtest.h)
  used=$(find "$WORKSPACE/build" -name '*.d' -exec cat {} + | tr ' ' '\n' | sort -u)
  for i in "${!headers[@]}"; do
    header=${headers[i]} library=${LIBRARIES[i]}
    folder=$(cached "${library}_DIR")
    mapfile -t files < <(grep -E "/$header\$" <<<"$used" | xargs -r realpath | sort -u)
    ((${#files[@]} > 0)) || fail "nothing of $library was read: is the build complete?"
    ((${#files[@]} == 1)) || fail "$library was read from several places: ${files[*]}"
    # <prefix>/lib/cmake/NAME and <prefix>/share/NAME/cmake
    [[ ${files[0]} == "$(realpath "$folder/../../..")"/* ]] ||
      fail "$library is found in $folder, but ${files[0]} was read"
  done
  echo "all headers from there"
}

# As in scripts/test.sh.
run_ctest() {
  cd "$WORKSPACE/build"
  rm -rf test_results Testing
  ctest --show-only=json-v1 "$@" >ctest.json
  ctest --output-on-failure --timeout 1800 "$@" || true
}

main() {
  local regexp=
  while getopts hR: option; do
    case $option in
      R) regexp=$OPTARG ;;
      h) usage && exit ;;
      *) usage >&2 && exit 2 ;;
    esac
  done
  shift $((OPTIND - 1))
  (($# > 0)) || { usage >&2 && exit 2; }
  local prefix
  for prefix in "$@"; do
    [[ -d $prefix ]] || fail "$prefix is no folder"
  done
  mapfile -t prefixes < <(realpath "$@")

  install_packages
  load_ros
  use_prefixes "${prefixes[@]}"
  create_workspace
  IMU_POSE_CALIB_CMAKE_ARGS+=" -DIMU_POSE_CALIB_WERROR=ON -DCMAKE_CXX_FLAGS=-MD"
  step "build" build catkin_build
  print_versions
  step "build the tests" build_tests catkin_build tests
  check_headers
  [[ $regexp != '^$' ]] || return 0
  load_workspace
  use_prefixes "${prefixes[@]}"
  step "run the tests" run_tests run_ctest ${regexp:+-R "$regexp"}
  /usr/bin/python3 "$REPO/scripts/count_tests.py" "$WORKSPACE/build" "$LOG_DIR/run_tests.log"
}

main "$@"
