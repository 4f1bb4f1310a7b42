# Completion in bash of the options of this package's programs, called by their path or by rosrun. The setup.bash of the
# workspace sources this file. The options are those that the program itself prints.

# _imu_pose_calib_options PROGRAM: sets COMPREPLY; left empty, bash completes file names.
_imu_pose_calib_options() {
  COMPREPLY=()
  local word=${COMP_WORDS[COMP_CWORD]} help=--help
  [[ $word == -* ]] || return 0
  [[ ${1##*/} != calibrate_bag ]] || help=--help-all
  mapfile -t COMPREPLY < <(compgen -W "$("$1" "$help" 2>/dev/null | grep -oE '^ +--[a-z-]+')" -- "$word")
}

_imu_pose_calib_program() {
  _imu_pose_calib_options "$1"
}

_imu_pose_calib_rosrun() {
  if [[ ${COMP_WORDS[1]} == imu_pose_calib ]] && ((COMP_CWORD > 2)); then
    local program
    program=$(catkin_find --first-only --libexec imu_pose_calib "${COMP_WORDS[2]}" 2>/dev/null)
    [[ ! -x $program ]] || _imu_pose_calib_options "$program"
    return
  fi
  # As without this file: bash-completion loads the function when it is first asked for, and then puts it in our place.
  if ! declare -F _roscomplete_exe >/dev/null && declare -F _completion_loader >/dev/null; then
    _completion_loader rosrun
    complete -o default -F _imu_pose_calib_rosrun rosrun
  fi
  ! declare -F _roscomplete_exe >/dev/null || _roscomplete_exe "$@"
}

complete -o default -F _imu_pose_calib_program \
  aggregate_clouds calibrate_bag compare_calibrations evaluate export_calibration simulate_bag
complete -o default -F _imu_pose_calib_rosrun rosrun
