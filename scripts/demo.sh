#!/usr/bin/env bash
# Calibrates the sample recording, or yours, and ends with the result.
#
#   scripts/demo.sh
#   scripts/demo.sh bag:=my.bag imu_topic:=/imu marker_frame:=body      any argument of calibrate.launch
#
# The result is written next to the bag (my.calibration.yaml) or to output:=FILE. The exit status is 0 when it was.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

# absolute_paths ARGUMENT...: the arguments, one a line, with file names made absolute: nodes run in another folder.
absolute_paths() {
  local argument
  for argument in "$@"; do
    case $argument in
      bag:=?* | poses:=?* | imu:=?* | gyro:=?* | accel:=?* | output:=?* | config:=?* | imu_yaml:=?* | trajectory:=?*)
        printf '%s:=%s\n' "${argument%%:=*}" "$(realpath -m -- "${argument#*:=}")"
        ;;
      *) printf '%s\n' "$argument" ;;
    esac
  done
}

# value_of NAME ARGUMENT...: VALUE of the last NAME:=VALUE.
value_of() {
  local name=$1 argument value=
  shift
  for argument in "$@"; do
    [[ $argument != "$name":=* ]] || value=${argument#*:=}
  done
  printf '%s\n' "$value"
}

# The result file that calibrate.launch writes when given these arguments.
result_file() {
  local output recording name
  output=$(value_of output "$@")
  recording=$(value_of bag "$@")
  [[ -n $recording ]] || recording=$(value_of poses "$@")
  [[ -n $recording ]] || recording=$(find "$REPO/data" -name '*.bag' | sort | head -n 1)
  name=${recording##*/}
  printf '%s\n' "${output:-${recording%"$name"}${name%.*}.calibration.yaml}"
}

# Passes on what the nodes say and leaves out colours and what roslaunch says of itself.
node_output() {
  sed -u -n -E '
    s/\x1b\[[0-9;]*m//g
    s/\x1b\]2;[^\a]*\a//g
    /^started core service/,$ {
      /^started core service/d
      /^process\[.*\]: started with pid/d
      /^\[[^]]*\] (process has finished cleanly|killing on exit)/d
      /^=*REQUIRED process .* has died!/d
      /^process has finished cleanly/d
      /^log file: /d
      /^Initiating shutdown!/d
      /^=+$/d
      /^all processes on machine have died/d
      /^(\.\.\. )?shutting down processing monitor/d
      /^done$/d
      p
    }'
}

main() {
  local arguments result started log=$LOG_DIR/demo.log
  mapfile -t arguments < <(absolute_paths "$@")
  result=$(result_file "${arguments[@]}")
  arguments+=("output:=$result")
  setup calibrate_node
  load_workspace

  # A master of its own, beside any other. roslaunch ends with 0 whatever its nodes do: only a new file is a result.
  started=$(mktemp)
  ROS_MASTER_URI=http://localhost:$(free_port)
  export ROS_MASTER_URI
  echo "calibrate (log: $log)"
  # Unbuffered, so that its lines and those of the nodes come in order.
  PYTHONUNBUFFERED=1 roslaunch imu_pose_calib calibrate.launch exit:=true "${arguments[@]}" </dev/null 2>&1 |
    tee "$log" | node_output || true
  local is_new=false
  [[ ! $result -nt $started ]] || is_new=true
  rm -f "$started"
  if ! $is_new; then
    grep -q '^started core service' "$log" || tail -n 20 "$log" >&2
    fail "no result: $result was not written"
  fi
}

main "$@"
