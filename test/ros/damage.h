#pragma once

#include <algorithm>
#include <cstdlib>
#include <random>
#include <string>

namespace imu_pose_calib {

/// Damages a few bits, bytes, a run of bytes or what may be a length; or cuts the text off or a
/// part out.
inline std::string Damage(std::string text, std::mt19937* random) {
  const auto below = [&](size_t size) {
    return std::uniform_int_distribution<size_t>(0, size - 1)(*random);
  };
  // A third of the damage goes to the headers at the start, a third to the index at the end.
  const size_t part = std::min<size_t>(text.size(), 6000);
  const auto position = [&] {
    switch (below(3)) {
      case 0:
        return below(part);
      case 1:
        return text.size() - 1 - below(part);
      default:
        return below(text.size());
    }
  };
  const auto flip = [&](size_t at) {
    text[at] = static_cast<char>(static_cast<unsigned char>(text[at]) ^ (1u << below(8)));
  };
  switch (below(6)) {
    case 0:
      flip(position());
      break;
    case 1:
      for (int k = 0; k < 20; ++k) flip(position());
      break;
    case 2:
      text.resize(position());
      break;
    case 3:
      text.erase(position(), 1 + below(100));
      break;
    case 4: {  // four bytes that would be a huge number, a negative one, or nearly so
      const size_t begin = position();
      const char* bytes = below(2) == 0 ? "\xff\xff\xff\xff" : "\xff\xff\xff\x7f";
      for (size_t k = begin; k < std::min(text.size(), begin + 4); ++k) text[k] = bytes[k - begin];
      break;
    }
    default: {
      const size_t begin = position();
      for (size_t k = begin; k < std::min(text.size(), begin + 64); ++k)
        text[k] = static_cast<char>(below(256));
    }
  }
  return text;
}

/// Copies of each kind; the environment may ask for more.
inline int Copies() {
  const char* text = std::getenv("IMU_POSE_CALIB_DAMAGED_BAGS");
  return text ? std::atoi(text) : 40;
}

}  // namespace imu_pose_calib
