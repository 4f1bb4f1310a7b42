# ROS Noetic with the package built in /imu_pose_calib:
#
#   docker build -t imu_pose_calib .
#   docker run --rm -v /path/to/bags:/bags imu_pose_calib rosrun imu_pose_calib calibrate_bag /bags/my.bag
FROM ros:noetic-ros-base

COPY . /imu_pose_calib
RUN /imu_pose_calib/scripts/setup.sh && rm -rf /var/lib/apt/lists/*

RUN printf '#!/bin/bash\nsource /imu_pose_calib/.catkin_ws/devel/setup.bash\nexec "$@"\n' >/entrypoint.sh && \
    chmod +x /entrypoint.sh
ENTRYPOINT ["/entrypoint.sh"]
CMD ["bash"]
