#include <csignal>
#include <new>

#include "imu_pose_calib/core/types.h"
#include "imu_pose_calib/ros/io/child_process.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

std::optional<std::string> Apart(const std::function<std::string()>& run) {
  return RunApart(run, 1, uint64_t{1} << 40);
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
}

}  // namespace
}  // namespace imu_pose_calib
