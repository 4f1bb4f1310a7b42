#include <poll.h>

#include <csignal>
#include <new>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/child_process.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using Run = std::function<std::string()>;

constexpr uint64_t kMemory = uint64_t{1} << 40;

std::optional<std::string> Apart(const Run& run) { return RunApart(run, {1, 60, kMemory}); }

[[noreturn]] void Sleep() {
  for (;;) pause();
}

TEST(RunApart, HandsOverTheBytes) {
  std::string bytes(1 << 20, '\0');
  bytes[12345] = 'x';
  EXPECT_EQ(Apart([&] { return bytes; }), bytes);
  EXPECT_EQ(Apart([] { return ""; }), "");
}

TEST(RunApart, HandsOverTheInputError) {
  ExpectError<InputError>([] { Apart([]() -> std::string { throw InputError("field = 1"); }); },
                          {"field = 1"});
}

TEST(RunApart, ContainsWhateverElseHappens) {
  EXPECT_FALSE(Apart([]() -> std::string { throw std::bad_alloc(); }));
  EXPECT_FALSE(Apart([] {
    std::raise(SIGKILL);
    return "";
  }));
  EXPECT_FALSE(Apart([] {
    while (getpid() != 0) continue;  // until the processor time is used up
    return "";
  }));
  EXPECT_FALSE(Apart([]() -> std::string { _exit(EXIT_SUCCESS); }));
}

TEST(RunApart, EndsAChildThatOnlyWaits) {
  int alive[2];  // open for writing as long as the child lives
  ASSERT_EQ(pipe(alive), 0);
  EXPECT_FALSE(RunApart([]() -> std::string { Sleep(); }, {60, 1, kMemory}));
  close(alive[1]);
  char byte;
  EXPECT_EQ(read(alive[0], &byte, 1), 0);
  close(alive[0]);
}

/// Kills a process that runs `run` apart as soon as its child has begun; whether the child ends.
bool EndsWithItsParent(const Run& run) {
  int alive[2];  // the child says that it has begun, and has this open as long as it lives
  if (pipe(alive) != 0) return false;
  const pid_t parent = fork();
  if (parent == 0) {
    RunApart(
        [&] {
          (void)!write(alive[1], "x", 1);
          return run();
        },
        {60, 60, kMemory});
    _exit(EXIT_SUCCESS);
  }
  close(alive[1]);
  char byte;
  bool has_ended = read(alive[0], &byte, 1) == 1;
  kill(parent, SIGKILL);
  waitpid(parent, nullptr, 0);
  pollfd end{alive[0], POLLIN, 0};
  has_ended = has_ended && poll(&end, 1, 10'000) == 1 && read(alive[0], &byte, 1) == 0;
  close(alive[0]);
  return has_ended;
}

TEST(RunApart, EndsWithItsParent) {
  EXPECT_TRUE(EndsWithItsParent([]() -> std::string { Sleep(); }));
  // more than a pipe holds
  EXPECT_TRUE(EndsWithItsParent([] { return std::string(100 << 20, 'x'); }));
}

}  // namespace
}  // namespace imu_pose_calib
