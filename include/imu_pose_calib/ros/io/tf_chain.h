#pragma once

#include <tf2_msgs/TFMessage.h>

#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "imu_pose_calib/core/base/types.h"

namespace tf2 {
class BufferCore;  // its header takes long to compile
}

namespace imu_pose_calib {

/// Poses of one tf frame in another, from the messages of /tf and /tf_static. The frames may be any
/// number of links apart, fixed or moving; tf2 composes and interpolates them.
///
/// There is one pose per update of a link that moves, as soon as every link is known at that stamp.
/// Links that are repeated but never change bring no poses of their own.
class TfChain {
 public:
  /// Poses of `child` in `parent` (W and M); leading slashes are ignored here and in messages.
  /// `cache_s`: how far apart in time links of the same stamp may arrive [s].
  TfChain(const std::string& parent, const std::string& child, double cache_s);

  /// A message of /tf, or of /tf_static when `fixed`.
  void Add(const tf2_msgs::TFMessage& message, bool fixed);

  /// The poses that have become known since the last call. A pose is NaN when an update that
  /// belongs to it is unusable: not finite, or its quaternion is not of unit length.
  std::vector<PoseSample> TakePoses();

  /// How many updates have been kept for poses that are not known yet.
  size_t Pending() const;

  /// Why the links seen so far cannot give poses, naming the frames: one is missing, the two are
  /// not connected, or nothing between them moves. Empty: they can.
  std::string Problem() const;

  /// All links seen so far, printable: "world -> base, base -> tool (fixed)".
  std::string Links() const;
  /// Parent and child of the only link seen so far; no value when there are none or several.
  std::optional<std::pair<std::string, std::string>> SinglePair() const;

 private:
  /// The link from a frame, which is the key of `links_`, to its parent.
  struct Link {
    std::string parent;
    bool fixed = false;
    bool moves = false;           ///< has changed
    int64_t first = 0, last = 0;  ///< [ns] stamps of usable updates; 0: none
    geometry_msgs::Transform first_transform;
    /// Stamps [ns] of updates that call for a pose and have not been taken; whether one of this
    /// stamp is unusable.
    std::map<int64_t, bool> updates;
  };

  void AddMoving(const geometry_msgs::TransformStamped& transform);
  /// The frame and those above it, up to the root.
  std::vector<std::string> Ancestry(std::string frame) const;
  /// Keys of the links between the two frames that are not fixed; no value when the frames are not
  /// connected.
  std::optional<std::vector<std::string>> Chain() const;

  std::string parent_, child_;
  int64_t cache_ns_;
  std::shared_ptr<tf2::BufferCore> buffer_;
  std::map<std::string, Link> links_;
  int64_t last_taken_ = 0;  ///< [ns]
};

}  // namespace imu_pose_calib
