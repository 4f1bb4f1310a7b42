#include "imu_pose_calib/ros/io/text.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

TEST(Printable, KeepsWhatCanBePrinted) {
  for (const char* text : {"", "/imu_0/data raw~", "Köln", "東京", "\xf0\x9f\x9a\x81", "C:\\bags"})
    EXPECT_EQ(Printable(text), text);
}

TEST(Printable, WritesControlCharactersAsBytes) {
  EXPECT_EQ(Printable("\x1b[31mred\x7f\n"), "\\x1b[31mred\\x7f\\x0a");
  EXPECT_EQ(Printable(std::string("a\0b", 3)), "a\\x00b");
  EXPECT_EQ(Printable("\xc2\x9b"), "\\xc2\\x9b");           // as good as ESC [
  EXPECT_EQ(Printable("\xe2\x80\xae"), "\\xe2\\x80\\xae");  // turns the line around
}

TEST(Printable, WritesWhatIsNoUtf8AsBytes) {
  EXPECT_EQ(Printable("\xff/imu\x80"), "\\xff/imu\\x80");
  EXPECT_EQ(Printable("\xc3"), "\\xc3");                             // cut off
  EXPECT_EQ(Printable("\xc3("), "\\xc3(");                           // no continuation
  EXPECT_EQ(Printable("\xc0\xaf"), "\\xc0\\xaf");                    // a longer form of "/"
  EXPECT_EQ(Printable("\xe0\x80\xaf"), "\\xe0\\x80\\xaf");           // the same
  EXPECT_EQ(Printable("\xed\xa0\x80"), "\\xed\\xa0\\x80");           // half of a pair
  EXPECT_EQ(Printable("\xf4\x90\x80\x80"), "\\xf4\\x90\\x80\\x80");  // beyond the last
}

TEST(Printable, TwiceIsOnce) {
  const std::string once = Printable("\x1b\xff\\x1b");
  EXPECT_EQ(Printable(once), once);
}

}  // namespace
}  // namespace imu_pose_calib
