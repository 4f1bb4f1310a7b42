#!/usr/bin/env bash
# Installs what the package needs and builds it in <repository>/.catkin_ws.
#
#   scripts/setup.sh           Debian 12, or Ubuntu 20.04 with ROS Noetic's apt source. A second run takes seconds.
#   source scripts/setup.sh    only defines the functions below, which demo.sh, test.sh and .ci/run share.
#
# IMU_POSE_CALIB_CMAKE_ARGS="-DNAME=VALUE ..."   more arguments for cmake
# IMU_POSE_CALIB_SKIP_INSTALL=1                  never call apt: the packages are there, or not to be touched
set -euo pipefail

REPO=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
WORKSPACE=$REPO/.catkin_ws
LOG_DIR=$WORKSPACE/log

# On every system.
COMMON_PACKAGES=(
  build-essential cmake make pkg-config python3 python3-matplotlib python3-numpy python3-yaml
  libboost-dev libboost-program-options-dev libceres-dev libconsole-bridge-dev libeigen3-dev libyaml-cpp-dev libcereal-dev
  liblz4-dev libsqlite3-dev libzstd-dev
  libgtest-dev libbenchmark-dev
)

# Debian splits a message package in three: lib*-dev holds the headers, ros-* the definitions that other messages need,
# python3-* what rostopic and rosservice need.
DEBIAN_PACKAGES=(
  catkin ros-core rosbash ros-environment ros-message-generation ros-message-runtime
  libroscpp-dev libroslib-dev librosbag-dev librosbag-storage-dev libtf2-ros-dev libtf2-msgs-dev libtf2-eigen-dev
  libdiagnostic-updater-dev libtopic-tools-dev librostest-dev python3-rostest
  libstd-msgs-dev libstd-srvs-dev libgeometry-msgs-dev libsensor-msgs-dev libnav-msgs-dev libvisualization-msgs-dev
  libdiagnostic-msgs-dev
  ros-std-msgs ros-std-srvs ros-geometry-msgs ros-sensor-msgs ros-nav-msgs ros-visualization-msgs ros-diagnostic-msgs
  ros-tf2-msgs
  python3-std-srvs python3-diagnostic-msgs python3-nav-msgs python3-visualization-msgs
  rviz
)

NOETIC_PACKAGES=(
  ros-noetic-catkin ros-noetic-ros-base ros-noetic-message-generation ros-noetic-message-runtime
  ros-noetic-roscpp ros-noetic-roslib ros-noetic-rosbag ros-noetic-rosbag-storage ros-noetic-rostest
  ros-noetic-tf2-ros ros-noetic-tf2-msgs ros-noetic-tf2-eigen ros-noetic-diagnostic-updater ros-noetic-diagnostic-msgs
  ros-noetic-std-msgs ros-noetic-std-srvs ros-noetic-geometry-msgs ros-noetic-sensor-msgs ros-noetic-nav-msgs
  ros-noetic-topic-tools ros-noetic-visualization-msgs ros-noetic-rviz
)

# fail TEXT...: one line on stderr, then leave.
fail() {
  printf 'error: %s\n' "$*" >&2
  exit 1
}

# step TITLE LOG COMMAND...: runs the command into $LOG_DIR/LOG.log and says in one line how long it took; when it fails,
# shows the end of the log and returns the command's status.
step() {
  local title=$1 log=$LOG_DIR/$2.log start=$SECONDS status
  shift 2
  mkdir -p "$LOG_DIR"
  printf '%-40s' "$title"
  set +e
  (set -e; "$@") >"$log" 2>&1 </dev/null
  status=$?
  set -e
  if ((status == 0)); then
    printf '%5d s\n' $((SECONDS - start))
  else
    printf 'FAILED after %d s\n' $((SECONDS - start))
    { tail -n 40 "$log"; printf 'error: %s failed; the whole log is %s\n' "$title" "$log"; } >&2
  fi
  return "$status"
}

# Prints "debian" (ROS from Debian's own packages) or "noetic" (packages of ros.org).
system_kind() {
  local id
  # shellcheck disable=SC1091
  id=$(. /etc/os-release && printf '%s %s' "${ID:-unknown}" "${VERSION_ID:-unknown}")
  case $id in
    "debian 12") echo debian ;;
    "ubuntu 20.04") echo noetic ;;
    *) fail "this is $id; the scripts know Debian 12 and Ubuntu 20.04. Install the dependencies named in package.xml" \
      "and run again with IMU_POSE_CALIB_SKIP_INSTALL=1" ;;
  esac
}

# Prints those of the packages named that are not installed.
missing_packages() {
  dpkg-query -W -f='${db:Status-Status} ${Package}\n' "$@" 2>/dev/null | sed -n 's/^installed //p' | sort -u |
    comm -13 - <(printf '%s\n' "$@" | sort -u)
}

apt_install() {
  local sudo=()
  if ((EUID != 0)); then
    command -v sudo >/dev/null || fail "neither root nor sudo: ask for $*"
    sudo=(sudo)
  fi
  local apt=("${sudo[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -q -o DPkg::Lock::Timeout=600 -o Acquire::Retries=3)
  "${apt[@]}" update
  if [[ $* == *ros-noetic-* ]] && ! apt-cache show ros-noetic-catkin >/dev/null 2>&1; then
    fail "apt has no ROS Noetic: add its source (http://wiki.ros.org/noetic/Installation/Ubuntu, sections 1.2 and 1.3)"
  fi
  "${apt[@]}" install -y --no-install-recommends "$@"
}

# install_packages [PACKAGE...]: installs what is missing for the build, and the packages named.
# shellcheck disable=SC2120
install_packages() {
  [[ ${IMU_POSE_CALIB_SKIP_INSTALL:-0} != 1 ]] || return 0
  local kind packages missing
  kind=$(system_kind)
  packages=("${COMMON_PACKAGES[@]}" "$@")
  case $kind in
    debian) packages+=("${DEBIAN_PACKAGES[@]}") ;;
    noetic) packages+=("${NOETIC_PACKAGES[@]}") ;;
  esac
  mapfile -t missing < <(missing_packages "${packages[@]}")
  ((${#missing[@]} == 0)) || step "install packages (${#missing[@]} missing)" install apt_install "${missing[@]}"
}

# source_setup FILE: sources a catkin setup file, which reads unset variables and the caller's arguments.
source_setup() {
  local file=$1
  set --
  set +eu
  # shellcheck disable=SC1090
  source "$file"
  set -eu
}

# The environment of the build: ROS, and the system's Python, which alone has the ROS modules.
load_ros() {
  if [[ -f /opt/ros/noetic/setup.bash ]]; then
    source_setup /opt/ros/noetic/setup.bash
  fi
  export PATH=/usr/bin:$PATH
  command -v catkin_make >/dev/null || fail "catkin_make not found: is ROS installed?"
}

# load_workspace [DEVEL]: the environment to run what was built: a ROS graph of this machine alone, whose logs stay in
# the workspace.
load_workspace() {
  source_setup "${1:-$WORKSPACE/devel}/setup.bash"
  export PATH=/usr/bin:$PATH ROS_HOSTNAME=localhost ROS_HOME=$WORKSPACE/ros ROS_LOG_DIR=$LOG_DIR/ros
  unset ROS_IP
}

# For a master of our own, beside any other.
free_port() {
  /usr/bin/python3 -c 'import socket; s = socket.socket(); s.bind(("", 0)); print(s.getsockname()[1])'
}

# One compiler per core, but none without 2 GB of memory.
parallel_jobs() {
  local cores memory
  cores=$(nproc)
  memory=$(awk '/^MemAvailable:/ { print int($2 / 2e6) }' /proc/meminfo)
  echo $((memory < 1 ? 1 : memory < cores ? memory : cores))
}

create_workspace() {
  # One link for each entry: a link to the repository, which holds the workspace, would be a loop for rosrun.
  local package=$WORKSPACE/src/imu_pose_calib
  rm -rf "$package"
  mkdir -p "$package"
  ln -s "$REPO"/* "$package"
  # A build configured at another path cannot be used again.
  local cache=$WORKSPACE/build/CMakeCache.txt
  if [[ -f $cache ]] && ! grep -qxF "CMAKE_HOME_DIRECTORY:INTERNAL=$WORKSPACE/src" "$cache"; then
    rm -rf "$WORKSPACE/build" "$WORKSPACE/devel"
  fi
}

# catkin_build [TARGET...]
catkin_build() {
  local arguments
  read -ra arguments <<<"${IMU_POSE_CALIB_CMAKE_ARGS:-}"
  PYTHONUNBUFFERED=1 catkin_make --no-color -C "$WORKSPACE" -j"$(parallel_jobs)" "$@" \
    -DCMAKE_BUILD_TYPE=Release -DCMAKE_EXPORT_COMPILE_COMMANDS=ON -DIMU_POSE_CALIB_WERROR=OFF \
    -DPYTHON_EXECUTABLE=/usr/bin/python3 -DPython3_EXECUTABLE=/usr/bin/python3 "${arguments[@]}"
  # For clangd and clang-tidy, which can read no headers that gcc has compiled.
  sed -i -E 's/ (-Winvalid-pch|-include [^ ]*cmake_pch[.]hxx|--param=[^ ]*)//g' "$WORKSPACE/build/compile_commands.json"
}

# setup [TARGET...]: everything up to a built workspace.
setup() {
  install_packages
  load_ros
  create_workspace
  step "build" build catkin_build "$@"
}

if [[ ${BASH_SOURCE[0]} == "$0" ]]; then
  setup
  echo "built; to use it: source $WORKSPACE/devel/setup.bash"
fi
