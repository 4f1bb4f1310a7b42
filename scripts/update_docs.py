#!/usr/bin/python3
"""Runs the commands of the documents; see update_docs.sh, which sets up what they need.

Of a ```bash block every line is a command; of a ```console block those that start with '$ ', and the rest is what they print.
They run in a folder of their own where my.bag and the other recordings are simulated ones, and '/path/to/' is that folder. A
comment on the line before the block says what is different:

    <!-- not run: REASON -->                    its commands are not run
    <!-- shows: 1-9, 14, ... -->                these lines of the output, and '  ...' for those left out between
    <!-- output of: COMMAND; shows: ... -->     the block is output only
"""
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time

REPO = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
# Math and measurements that take hours.
LEFT_OUT = ("doc/math.md",)
# What the documents take for granted, made in this order.
RECORDINGS = (
    "simulate_bag my.bag --lidar --duration 25",
    "cp my.lidar.yaml lidar.yaml",
    "simulate_bag A.bag --imus 2 --duration 20 --seed 2",
    "simulate_bag B.bag --imus 2 --duration 20 --seed 3",
    "simulate_bag C.bag --imus 2 --duration 20 --seed 4",
    "simulate_bag V1_01_easy --format asl --duration 20; mkdir V1_01_easy/mav0; mv V1_01_easy/mocap0 V1_01_easy/mav0/vicon0; mv V1_01_easy/imu0 V1_01_easy/mav0",
    "simulate_bag sim --format text --duration 20",
    "simulate_bag rig.bag --pose-sensor --duration 20",
    "simulate_bag slam --format text --pose-sensor --duration 25; cp slam.pose_sensor.txt slam.txt",
    "simulate_bag split --format text --split --duration 20",
    "cp sim.poses.txt poses.txt; cp sim.imu.csv imu.csv; cp split.gyro.csv gyro.csv; cp split.accel.csv accel.csv",
    "calibrate_bag A.bag --imu-topic /imu --output A.yaml --quiet",
    "calibrate_bag B.bag --imu-topic /imu --output B.yaml --quiet",
    "calibrate_bag C.bag --imu-topic /imu --output C.yaml --quiet",
)
CAMCHAIN = """cam0:
  T_cam_imu: [[1, 0, 0, 0.01], [0, 1, 0, 0.02], [0, 0, 1, 0.03], [0, 0, 0, 1]]
  timeshift_cam_imu: 0.001
  camera_model: pinhole
  intrinsics: [460.0, 460.0, 320.0, 240.0]
  distortion_model: radtan
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  resolution: [640, 480]
  rostopic: /cam0
"""
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")
PATIENCE = 120  # [s] for what a launch file does


class Commands:
    """Runs commands in the scratch folder; what a launch file starts stays until the block ends."""

    def __init__(self, folder):
        self.folder = folder
        self.launched = []
        self.env = dict(os.environ, COLUMNS="120", IMU_POSE_CALIB_SKIP_INSTALL="1")
        with socket.socket() as s:
            s.bind(("", 0))
            self.env["ROS_MASTER_URI"] = f"http://localhost:{s.getsockname()[1]}"

    def shell(self, command, timeout=600):
        done = subprocess.run(["bash", "-c", command], cwd=self.folder, env=self.env, timeout=timeout,
                              stdout=subprocess.PIPE, stderr=subprocess.STDOUT, universal_newlines=True)
        return done.returncode, done.stdout

    def start(self, command, name):
        log = open(os.path.join(self.folder, name), "w+")
        self.launched.append((subprocess.Popen(["bash", "-c", "exec " + command], cwd=self.folder, env=self.env,
                                               stdout=log, stderr=subprocess.STDOUT, start_new_session=True), log.name))
        return self.launched[-1]

    def launch(self, command):
        process, log = self.start(command, f"launch{len(self.launched)}.log")
        if " live.launch" in command:  # beside the bridge of somebody's lab
            self.start("rosrun imu_pose_calib replay_bridge _input:=/mocap/pose", "bridge.log")
            self.start("rosbag play --delay=5 data/estimator_own_clocks.bag", "bag.log")
        until = time.time() + PATIENCE
        while time.time() < until:
            with open(log) as printed:
                text = printed.read()
            ended = process.poll()
            if ended is not None:
                return ended, text
            if "Written to" in text:
                return 0, text
            if "live" in command and self.shell("rostopic echo -n 1 /imu_pose_calib/result", PATIENCE)[0] == 0:
                return 0, text
            time.sleep(0.5)
        return 1, text + f"\nnothing written within {PATIENCE} s"

    def run(self, command):
        command = re.sub(r"^scripts/", REPO + "/scripts/", command.replace("/path/to/", self.folder + "/"))
        if command.startswith("roslaunch"):
            return self.launch(command)
        return self.shell(command)

    def end_block(self):
        for process, _ in reversed(self.launched):
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGINT)
        for process, _ in self.launched:
            process.wait(timeout=60)
        self.launched = []


def prepare(folder):
    """A folder as a reader of the documents would stand in, with recordings."""
    for name in ("data", "config"):
        os.symlink(os.path.join(REPO, name), os.path.join(folder, name))
    with open(os.path.join(folder, "camchain-imucam.yaml"), "w") as out:
        out.write(CAMCHAIN)
    commands = Commands(folder)
    for line in RECORDINGS:
        status, text = commands.shell(re.sub(r"(^|; )(simulate_bag|calibrate_bag)", r"\1rosrun imu_pose_calib \2", line))
        if status != 0:
            sys.exit(f"update_docs: {line}: {text}")
    return commands


def shown(output, lines):
    """The lines 'A-B, C' of an output, and dots for those between."""
    output = output.rstrip("\n").split("\n")
    if not lines:
        return output
    kept, last = [], 0
    for part in lines.replace("...", str(len(output) + 1)).split(","):
        begin, _, end = part.strip().partition("-")
        begin, end = int(begin), int(end or begin)
        if last and begin > last + 1:
            kept.append("  ...")
        kept += output[begin - 1:end]
        last = end
    return kept


def same(old, new):
    """Whether two texts are the same but for spaces and what rounding does to numbers on another machine."""
    if [NUMBER.sub("#", line).split() for line in old] != [NUMBER.sub("#", line).split() for line in new]:
        return False
    for a, b in zip(NUMBER.findall("\n".join(old)), NUMBER.findall("\n".join(new))):
        digits = len(b.partition(".")[2])
        if abs(float(a) - float(b)) > max(0.02 * abs(float(b)), 5.0 * 10.0 ** -digits):
            return False
    return True


def command_of(line):
    return re.sub(r"\s+#.*$", "", line)


def join_continued(lines):
    return "\n".join(lines).replace("\\\n", "").split("\n")


def update(name, commands):
    """The document with renewed output, and what went wrong or differs."""
    with open(os.path.join(REPO, name)) as file:
        lines = file.read().split("\n")
    result, remarks, k = [], [], 0
    while k < len(lines):
        result.append(lines[k])
        k += 1
        kind = result[-1]
        if not kind.startswith("```"):
            continue
        end = lines.index("```", k)
        block, note = lines[k:end], result[-2] if len(result) > 1 else ""
        k = end + 1
        comment = re.match(r"<!-- (not run|output of|shows): (.*?)(?:; shows: (.*))? -->$", note)
        what, value, picked = comment.groups() if comment else (None, None, None)
        if what == "not run" or (kind not in ("```bash", "```console")):
            result += block + [lines[end]]
            continue

        def run(command):
            print(f"{name}: {command}", flush=True)
            status, output = commands.run(command)
            if status != 0 and not (status == 2 and "compare_calibrations" in command):
                remarks.append(f"{name}: '{command}' ends with {status}:\n{output[-2000:]}")
            return output

        if what == "output of":
            new = shown(run(value), picked)
        elif kind == "```bash":
            for line in join_continued(block):
                if command_of(line).strip():
                    run(command_of(line))
            new = block
        else:
            new, output = [], ""
            for line in block:
                if line.startswith("$ "):
                    new += [line]
                    output += run(line[2:])
            new += shown(output, value)
        commands.end_block()
        if not same(block, new):
            remarks.append(f"{name}: the output shown is not that of today:\n" + "\n".join(new))
        result += (block if same(block, new) else new) + [lines[end]]
    return "\n".join(result), remarks


def main():
    arguments = sys.argv[1:]
    check = "--check" in arguments
    names = [a for a in arguments if a != "--check"]
    if not names:
        documents = sorted("doc/" + n for n in os.listdir(os.path.join(REPO, "doc")) if n.endswith(".md"))
        names = ["README.md"] + [n for n in documents if n not in LEFT_OUT]
    failures = 0
    with tempfile.TemporaryDirectory(prefix="imu_pose_calib_docs.") as folder:
        commands = prepare(folder)
        for name in names:
            text, remarks = update(name, commands)
            failures += len([r for r in remarks if check or "ends with" in r])
            for remark in remarks:
                print(remark, file=sys.stderr)
            if not check:
                with open(os.path.join(REPO, name), "w") as file:
                    file.write(text)
    print(f"{failures} remarks" if failures else "nothing differs" if check else "written", flush=True)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
