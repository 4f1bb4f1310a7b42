#!/usr/bin/env bash
# What a release needs beside the tests: one version everywhere, catkin_lint and doxygen (as rosdoc_lite runs it) without
# a warning, and an install space, .catkin_ws/install, that is used in place of the repository: programs, launch files,
# sample, the scripts that draw, completion, and the libraries from another package.
#
#   scripts/check_release.sh
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

INSTALL=$WORKSPACE/install
SCRATCH=$WORKSPACE/check_release
SHARE=$INSTALL/share/imu_pose_calib

check_versions() {
  local version
  version=$(sed -n 's/.*<version>\(.*\)<.*/\1/p' "$REPO/package.xml")
  grep -qx "$version ([0-9-]*)" "$REPO/CHANGELOG.rst" || fail "CHANGELOG.rst has no version $version"
  head -n 1 "$REPO/debian/changelog" | grep -qF "($version)" || fail "debian/changelog does not begin with $version"
}

# In the workspace, where the folder has the package's name.
check_catkin_lint() {
  catkin_lint -W2 --strict --offline "$WORKSPACE/src/imu_pose_calib"
}

# The settings of rosdoc.yaml, and those of rosdoc_lite's own template that bear on warnings.
check_doxygen() {
  local doxyfile=$SCRATCH/Doxyfile warnings
  /usr/bin/python3 - "$REPO/rosdoc.yaml" >"$doxyfile" <<'PYTHON'
import sys, yaml
for key, value in yaml.safe_load(open(sys.argv[1]))[0].items():
    if key not in ('builder', 'name', 'output_dir'):
        print(key.upper(), '=', value)
PYTHON
  cat >>"$doxyfile" <<DOXYFILE
INPUT = $REPO
OUTPUT_DIRECTORY = $SCRATCH/doxygen
EXTRACT_ALL = YES
EXTRACT_PRIVATE = YES
EXTRACT_STATIC = YES
RECURSIVE = YES
GENERATE_LATEX = NO
HAVE_DOT = NO
QUIET = YES
DOXYFILE
  mkdir -p "$SCRATCH/doxygen"
  warnings=$(doxygen "$doxyfile" 2>&1 >/dev/null)
  [[ -z $warnings ]] || fail "$warnings"
  compgen -G "$SCRATCH/doxygen/html/class*.html" >/dev/null || fail "doxygen found no class"
}

install_package() {
  rm -rf "$INSTALL"
  catkin_build install -DCMAKE_INSTALL_PREFIX="$INSTALL"
}

# Every file of these folders is there, and none names the repository or the devel space.
check_files() {
  local folder file found
  for folder in config data launch rviz; do
    for file in "$REPO/$folder"/*; do
      [[ -s $SHARE/$folder/${file##*/} ]] || fail "$folder/${file##*/} is not installed"
    done
  done
  found=$(grep -rlIF -e "$REPO/src" -e "$REPO/include" -e "$WORKSPACE/devel" -e "$WORKSPACE/src" "$INSTALL" || true)
  [[ -z $found ]] || fail "these installed files name the source or the devel space: $found"
}

# written FILE...: each is there and holds something.
written() {
  local file
  for file in "$@"; do
    [[ -s $file ]] || fail "$file was not written"
  done
}

check_programs() {
  local program bag=$SHARE/data/estimator_own_clocks.bag
  cd "$SCRATCH"
  for program in "$INSTALL"/lib/imu_pose_calib/*; do
    [[ $program != *.py && $program != */calibrate_node && $program != */replay_bridge ]] || continue  # have none
    [[ -n $(rosrun imu_pose_calib "${program##*/}" --help) ]] || fail "$program has no --help"
  done
  rosrun imu_pose_calib calibrate_bag "$bag" --config "$SHARE/config/default.yaml" --output sample.yaml \
    --report sample.html --trajectory sample.tum
  written sample.yaml sample.html sample.tum
  rosrun imu_pose_calib export_calibration sample.yaml --export ros2 --output-dir exports
  written exports/*
  rosrun imu_pose_calib simulate_bag simulated.mcap --format mcap --duration 20
  rosrun imu_pose_calib calibrate_bag simulated.mcap --output simulated.yaml
  rosrun imu_pose_calib compare_calibrations sample.yaml sample.yaml
  rosrun imu_pose_calib simulate_bag clouds.bag --duration 10 --lidar
  rosrun imu_pose_calib aggregate_clouds clouds.bag --imu-sensor clouds.lidar.yaml --output clouds.pcd
  written simulated.yaml clouds.pcd
}

# The demo saves once it has converged, and then goes on.
check_live_demo() {
  local demo status=1
  roslaunch imu_pose_calib live_demo.launch rviz:=false auto_save:=true output:="$SCRATCH/live.yaml" &
  demo=$!
  for ((i = 0; i < 300 && status; ++i)); do
    sleep 1
    [[ ! -s live.yaml ]] || status=0
    kill -0 "$demo" || break
  done
  kill "$demo" || true
  wait "$demo" || true
  return "$status"
}

check_launch_files() {
  local file
  cd "$SCRATCH"
  for file in "$SHARE"/launch/*.launch; do
    [[ -n $(roslaunch imu_pose_calib "${file##*/}" --ros-args) ]] || fail "${file##*/} names no arguments"
  done
  ROS_MASTER_URI=http://localhost:$(free_port)
  export ROS_MASTER_URI
  roslaunch imu_pose_calib calibrate.launch bag:="$SHARE/data/estimator_own_clocks.bag" output:="$SCRATCH/launched.yaml" \
    exit:=true
  written launched.yaml
  check_live_demo
}

# completed WORD...: what _imu_pose_calib_rosrun offers for the last word.
completed() {
  COMP_WORDS=("$@") COMP_CWORD=$(($# - 1)) COMPREPLY=()
  _imu_pose_calib_rosrun "$1"
  echo "${COMPREPLY[*]}"
}

# setup.bash has sourced it.
check_completion() {
  [[ $(completed rosrun imu_pose_calib calibrate_bag my.bag --trajectory-g) == --trajectory-gaps ]]
  [[ $(completed rosrun imu_pose_calib simulate_bag --lid) == --lidar ]]
}

# A package of a user: finds this one, includes the headers of the core and of ROS, and links both libraries.
check_libraries() {
  local user=$SCRATCH/user
  mkdir -p "$user/src/user"
  cat >"$user/src/user/package.xml" <<'XML'
<package format="2">
  <name>user</name><version>0.0.0</version><description>Uses the libraries.</description>
  <maintainer email="nobody@user.invalid">nobody</maintainer><license>BSD-3-Clause</license>
  <buildtool_depend>catkin</buildtool_depend><depend>imu_pose_calib</depend>
</package>
XML
  cat >"$user/src/user/CMakeLists.txt" <<'CMAKE'
cmake_minimum_required(VERSION 3.16)
project(user CXX)
set(CMAKE_CXX_STANDARD 17)
find_package(catkin REQUIRED COMPONENTS imu_pose_calib)
catkin_package()
include_directories(${catkin_INCLUDE_DIRS})
add_executable(user user.cpp)
target_link_libraries(user ${catkin_LIBRARIES})
CMAKE
  {
    (cd "$INSTALL/include" && find imu_pose_calib -name '*.h' | sort | sed 's/.*/#include <&>/')
    echo 'int main() { return imu_pose_calib::Median({1.0, 2.0, 3.0}) == 2.0 ? 0 : 1; }'
  } >"$user/src/user/user.cpp"
  catkin_make --no-color -C "$user" -DPYTHON_EXECUTABLE=/usr/bin/python3
  "$user/devel/lib/user/user"
}

main() {
  install_packages catkin-lint doxygen
  setup
  rm -rf "$SCRATCH"
  mkdir -p "$SCRATCH"
  step "versions" versions check_versions
  step "catkin_lint" catkin_lint check_catkin_lint
  step "doxygen" doxygen check_doxygen
  step "install" install_package install_package
  unset CMAKE_PREFIX_PATH ROS_PACKAGE_PATH LD_LIBRARY_PATH PYTHONPATH
  load_ros
  load_workspace "$INSTALL"
  [[ $(rospack find imu_pose_calib) == "$SHARE" ]] || fail "rospack finds $(rospack find imu_pose_calib)"
  step "installed files" check_files check_files
  step "programs" check_programs check_programs
  step "launch files" check_launch_files check_launch_files
  step "completion" completion check_completion
  step "libraries in another package" check_libraries check_libraries
}

main
