#!/usr/bin/python3
"""Load of the live node: poses at 500 Hz and an IMU at 1 kHz, played in real time.

Every 10 s a line tells what has arrived, the memory, and the CPU time that all threads but the solver's have taken;
every minute ~calibrate is called and timed. At the end: whether messages were lost. Starts a master of its own; needs
the workspace sourced.

    benchmark/live_load.py [SECONDS]        600 s unless told
"""

import os
import signal
import subprocess
import sys
import tempfile
import time

import rosgraph
import rospy
from imu_pose_calib.msg import CalibrationStatus
from std_srvs.srv import Trigger

POSE_RATE, IMU_RATE = 500, 1000  # [Hz]
STEP = 10.0  # [s] between two lines
TICK = 1.0 / os.sysconf("SC_CLK_TCK")  # [s]
MASTER_PORT = "11399"


def start(*command):
    return subprocess.Popen(command, stdout=subprocess.DEVNULL)


def cpu_time(stat_path):
    """User and system time [s]."""
    with open(stat_path) as stat:
        fields = stat.read().rsplit(")", 1)[1].split()
    return TICK * (int(fields[11]) + int(fields[12]))


def resident(pid):
    """[MB]"""
    with open(f"/proc/{pid}/statm") as statm:
        return int(statm.read().split()[1]) * os.sysconf("SC_PAGESIZE") / 1e6


class Node:
    def __init__(self):
        path = subprocess.check_output(["catkin_find", "--first-only", "--libexec", "imu_pose_calib", "calibrate_node"])
        self.process = start(path.decode().strip())
        self.status = CalibrationStatus()
        self.subscriber = rospy.Subscriber("/imu_pose_calib/status", CalibrationStatus, self.on_status)
        rospy.wait_for_message("/imu_pose_calib/status", CalibrationStatus)
        self.threads = os.listdir(f"/proc/{self.process.pid}/task")  # those of a solve come and go

    def on_status(self, msg):
        self.status = msg

    def cpu_without_solves(self):
        return sum(cpu_time(f"/proc/{self.process.pid}/task/{thread}/stat") for thread in self.threads)

    def calibrate(self):
        """Wall time and CPU time of a solve of what is there now [s]."""
        while self.status.solve_time > 0.0:
            time.sleep(0.1)
        wall = time.time()
        cpu = cpu_time(f"/proc/{self.process.pid}/stat") - self.cpu_without_solves()
        answer = rospy.ServiceProxy("/imu_pose_calib/calibrate", Trigger)()
        cpu = cpu_time(f"/proc/{self.process.pid}/stat") - self.cpu_without_solves() - cpu
        return f"{time.time() - wall:.1f} s, CPU {cpu:.1f} s: {answer.message}"


def play(node, bag):
    """Prints the figures until the bag ends. Returns the CPU share of all threads but the solver's."""
    player = start("rosbag", "play", "--quiet", "--queue=100000", "--delay=2", bag)
    begin = line = time.time()
    first = last = node.cpu_without_solves()
    print(" time    poses      imu   window  memory    CPU  solves", flush=True)
    while player.poll() is None:
        line += STEP
        time.sleep(max(0.0, line - time.time()))
        cpu, now = node.cpu_without_solves(), time.time() - begin
        status = node.status
        print(f"{now:4.0f} s {status.pose_count:8} {status.gyro_count:8} {status.buffered:6.1f} s "
              f"{resident(node.process.pid):4.0f} MB {100.0 * (cpu - last) / STEP:4.1f} % {status.solves:7}", flush=True)
        last = cpu
        if round(now / STEP) % 6 == 0 and player.poll() is None:
            print("        solve:", node.calibrate(), flush=True)
    return (last - first) / (time.time() - begin)


def main():
    duration = float(sys.argv[1]) if len(sys.argv) > 1 else 600.0
    folder = tempfile.TemporaryDirectory()
    bag = os.path.join(folder.name, "load.bag")
    subprocess.check_call(["rosrun", "imu_pose_calib", "simulate_bag", bag, f"--duration={duration}",
                           f"--pose-rate={POSE_RATE}", f"--imu-rate={IMU_RATE}"])
    os.environ["ROS_MASTER_URI"] = "http://localhost:" + MASTER_PORT
    master = start("roscore", "-p", MASTER_PORT)
    while not rosgraph.is_master_online():
        time.sleep(0.1)
    rospy.init_node("live_load", disable_signals=True)
    node = Node()
    try:
        share = play(node, bag)
        published = int(subprocess.check_output(["rosbag", "info", "--yaml", "--key=messages", bag]))
        received = node.status.pose_count + node.status.gyro_count
        print(f"published {published}, received {received}, lost {published - received}; "
              f"all threads but the solver's took {100.0 * share:.1f} % of a core")
    finally:
        for process in (node.process, master):
            process.send_signal(signal.SIGINT)
            process.wait()


if __name__ == "__main__":
    main()
